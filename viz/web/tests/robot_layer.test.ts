import assert from "node:assert/strict";
import { test } from "node:test";
import { Vector3 } from "three";
import type { Occlusion } from "../src/layers/occlusion";
import type { Robot, RobotJoint } from "../src/connection/protocol";
import { RobotLayer } from "../src/layers/robot_layer";
import { assertClose } from "./close";

function translation(x: number, y: number, z: number): number[] {
  return [1, 0, 0, x, 0, 1, 0, y, 0, 0, 1, z, 0, 0, 0, 1];
}

function joint(name: string, kind: RobotJoint["kind"], parent: string, child: string): RobotJoint {
  return { name, kind, parent, child, parent_from_joint: translation(0, 0, 0), axis: [0, 0, 1], mimic: null };
}

/** A cart on which an arm of two links turns about z; the gripper slides along x, at half of the arm's angle plus 0.1. */
const ROBOT: Robot = {
  type: "robot",
  name: "test",
  base_link: "base",
  joint_names: ["shoulder", "elbow"],
  links: ["cart", "base", "upper", "lower", "gripper"].map((name) => ({ name, shapes: [] })),
  joints: [
    { ...joint("deck", "fixed", "cart", "base"), parent_from_joint: translation(0, 0, 0.5) },
    { ...joint("shoulder", "revolute", "base", "upper"), parent_from_joint: translation(0, 0, 1) },
    { ...joint("elbow", "revolute", "upper", "lower"), parent_from_joint: translation(2, 0, 0) },
    {
      ...joint("slide", "prismatic", "lower", "gripper"),
      axis: [1, 0, 0],
      mimic: { source: "shoulder", multiplier: 0.5, offset: 0.1 },
    },
  ],
};

function layerOf(robot: Robot): RobotLayer {
  const occlusion = { apply: (material: unknown) => material } as unknown as Occlusion;
  const layer = new RobotLayer(occlusion, () => undefined);
  layer.setRobot(robot);
  return layer;
}

function positions(layer: RobotLayer): Record<string, number[]> {
  const poses = layer.linkPoses();
  return Object.fromEntries(
    poses.map(([name, { worldFromFrame }]) => [name, new Vector3().setFromMatrixPosition(worldFromFrame).toArray()]),
  );
}

function setState(layer: RobotLayer, joints: number[]): void {
  layer.setState({
    type: "robot_state",
    stamp_nanos: 0,
    captured_millis: 0,
    world_from_base: translation(10, 20, 0),
    positions: joints,
  });
}

test("links follow the joint positions and the pose of the base", () => {
  const layer = layerOf(ROBOT);
  assert.deepEqual(layer.linkPoses(), [], "the state is unknown");
  assert.equal(layer.linkPose("base"), null);
  assert.ok(layer.box().isEmpty());
  setState(layer, [Math.PI / 2, -Math.PI / 2]);
  const found = positions(layer);
  assertClose(found.base!, [10, 20, 0], 1e-9);
  assertClose(found.cart!, [10, 20, -0.5], 1e-9);
  assertClose(found.upper!, [10, 20, 1], 1e-9);
  assertClose(found.lower!, [10, 22, 1], 1e-9);
  // The angles cancel each other: the gripper slides along world x.
  assertClose(found.gripper!, [10 + 0.25 * Math.PI + 0.1, 22, 1], 1e-9);
  // The last joint of the list moves the link "lower".
  assert.deepEqual(layer.namedLinks, { base: "base", tool: "lower" });
  const tool = new Vector3().setFromMatrixPosition(layer.linkPose("lower")!);
  assertClose(tool.toArray(), [10, 22, 1], 1e-9);
  assertClose(layer.box().min.toArray(), [10, 20, -0.5], 1e-9);
});

test("a joint can mimic a joint that mimics another one", () => {
  const wrist = {
    ...joint("wrist", "prismatic", "gripper", "finger"),
    mimic: { source: "slide", multiplier: -2, offset: 1 },
  };
  const layer = layerOf({
    ...ROBOT,
    links: [...ROBOT.links, { name: "finger", shapes: [] }],
    joints: [...ROBOT.joints, wrist],
  });
  setState(layer, [0.4, -0.4]);
  const found = positions(layer);
  // The slide is at 0.5 * 0.4 + 0.1 = 0.3, so the finger is at -2 * 0.3 + 1 above the gripper.
  assertClose([found.finger![2]! - found.gripper![2]!], [0.4], 1e-9);
});

test("joints that mimic each other end, and missing positions are 0", () => {
  const [deck, shoulder, elbow, slide] = ROBOT.joints as [RobotJoint, RobotJoint, RobotJoint, RobotJoint];
  const circular = [
    deck,
    { ...shoulder, mimic: { source: "elbow", multiplier: 1, offset: 0 } },
    { ...elbow, mimic: { source: "shoulder", multiplier: 1, offset: 0 } },
    slide,
  ];
  const layer = layerOf({ ...ROBOT, joints: circular });
  setState(layer, []);
  assertClose(positions(layer).lower!, [12, 20, 1], 1e-9);
});
