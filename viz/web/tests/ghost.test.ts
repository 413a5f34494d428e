import assert from "node:assert/strict";
import { test } from "node:test";
import type { Robot } from "../src/connection/protocol";
import type { Occlusion } from "../src/layers/occlusion";
import { RobotLayer } from "../src/layers/robot_layer";
import { Ghost } from "../src/steering/ghost";
import { assertClose } from "./close";

function translation(x: number, y: number, z: number): number[] {
  return [1, 0, 0, x, 0, 1, 0, y, 0, 0, 1, z, 0, 0, 0, 1];
}

/** A lift that carries an arm, which slides along x. */
const ROBOT: Robot = {
  type: "robot",
  name: "test",
  base_link: "floor",
  joint_names: ["lift", "slide"],
  links: ["floor", "base", "tip"].map((name) => ({ name, shapes: [] })),
  joints: [
    { name: "lift", kind: "prismatic", parent: "floor", child: "base", parent_from_joint: translation(0, 0, 0.5), axis: [0, 0, 1], mimic: null },
    { name: "slide", kind: "prismatic", parent: "base", child: "tip", parent_from_joint: translation(0.2, 0, 0), axis: [1, 0, 0], mimic: null },
  ],
};

function setUp(): { robot: RobotLayer; ghost: Ghost; n: () => number } {
  const occlusion = { apply: (material: object) => material } as unknown as Occlusion;
  let nChanges = 0;
  const changed = (): void => {
    nChanges += 1;
  };
  const robot = new RobotLayer(occlusion, () => undefined);
  const newRobotLayer: ConstructorParameters<typeof Ghost>[2]["newRobotLayer"] = (onChange, newLook) =>
    new RobotLayer(occlusion, onChange, newLook);
  Object.assign(globalThis, { devicePixelRatio: 1 });
  return { robot, ghost: new Ghost(robot, occlusion, { newRobotLayer }, changed), n: () => nChanges };
}

function setState(robot: RobotLayer, positions: number[]): void {
  robot.setState({ type: "robot_state", stamp_nanos: 0, captured_millis: 0, world_from_base: translation(10, 0, 0), positions });
}

test("the ghost has the steered joints at the goal, and the others where they are", () => {
  const { robot, ghost } = setUp();
  ghost.show(["slide"], [0.3], "reachable");
  assert.equal(ghost.root.visible, false, "the robot is unknown");
  robot.setRobot(ROBOT);
  setState(robot, [1, 0]);
  ghost.show(["slide"], [0.3], "reachable");
  assert.equal(ghost.root.visible, true);
  const tip = ghost.root.getObjectByName("tip")!;
  assertClose(tip.matrixWorld.elements.slice(12, 15), [10.5, 0, 1.5], 1e-9);
  // The robot itself has not moved.
  assertClose(robot.linkPose("tip")!.elements.slice(12, 15), [10.2, 0, 1.5], 1e-9);
  ghost.hide();
  assert.equal(ghost.root.visible, false);
});

test("the pose of the tip in the base is found at any joint positions", () => {
  const { robot, ghost } = setUp();
  assert.equal(ghost.linkInLink("base", "tip", ["slide"], [0.3]), null);
  robot.setRobot(ROBOT);
  setState(robot, [1, 0]);
  assertClose(ghost.linkInLink("base", "tip", ["slide"], [0.3])!.position.toArray(), [0.5, 0, 0], 1e-9);
  assert.equal(ghost.linkInLink("base", "hand", ["slide"], [0.3]), null);
  assert.equal(ghost.root.visible, false, "a question shows nothing");
});

test("the view is drawn again only if the ghost changes", () => {
  const { robot, ghost, n } = setUp();
  robot.setRobot(ROBOT);
  setState(robot, [1, 0]);
  ghost.show(["slide"], [0.3], "reachable");
  const before = n();
  ghost.show(["slide"], [0.3], "reachable");
  assert.equal(n(), before);
  ghost.show(["slide"], [0.3], "collision");
  assert.ok(n() > before);
  ghost.hide();
  const hidden = n();
  ghost.hide();
  assert.equal(n(), hidden);
});
