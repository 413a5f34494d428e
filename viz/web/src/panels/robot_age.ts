// Shows how old the drawn pose of the robot is, as soon as it is not live.

import { element } from "./element";
import { ageText } from "./quantities";
import type { RobotState } from "../connection/protocol";
import type { RobotLayer } from "../layers/robot_layer";
import type { Age, ServerClock } from "../connection/server_clock";

/** Poses older than this are not live. */
const LIVE_MILLIS = 500;

export class RobotAge {
  /** Whether the input has ended, so that an outdated pose is expected. */
  hasEnded = false;
  /** Age of the drawn pose; null before the first pose. */
  private age: Age | null = null;

  constructor(private readonly robot: RobotLayer, private readonly clock: ServerClock) {
    window.setInterval(() => this.show(), 100);
  }

  received(state: RobotState): void {
    this.age = this.clock.ageOf(state.captured_millis);
  }

  private show(): void {
    const label = element("robot-age");
    if (this.age === null) return;
    const millis = this.age() ?? Infinity;
    const isLive = millis <= LIVE_MILLIS;
    this.robot.setOutdated(!isLive);
    label.hidden = isLive || this.hasEnded || !this.robot.namedLinks;
    if (!isLive) label.textContent = `robot ${ageText(millis)}`;
  }
}
