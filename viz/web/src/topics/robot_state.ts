// The robot: its description, which comes once, and its joint positions.

import type { OrbitView } from "../view/orbit_view";
import type { Robot, RobotState } from "../connection/protocol";
import type { RobotAge } from "../panels/robot_age";
import { on, type Topic } from "./topic";

const HZ = 60;

export function robotTopic(view: OrbitView, age: RobotAge): Topic {
  return {
    name: "robot_state",
    capability: "robot",
    receivers: [
      on<Robot>("robot", (message) => {
        view.robot.setRobot(message);
      }),
      on<RobotState>("robot_state", (message) => {
        view.robot.setState(message);
        age.received(message);
      }),
    ],
    subscriptions: (isHidden) => [{ rate_hz: isHidden ? 0 : HZ }],
    restart: () => {
      view.robot.isOld = true;
    },
  };
}
