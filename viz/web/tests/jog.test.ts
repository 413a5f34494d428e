import assert from "node:assert/strict";
import { test } from "node:test";
import { Matrix4, Quaternion, Vector3 } from "three";
import { firstPad, padInput, withoutDeadZone } from "../src/steering/gamepad";
import { axesOf, deflectionOfKeys, type FrameName, jointVelocities, movedJoints, NO_DEFLECTION, tipVelocity } from "../src/steering/jog";
import { ARM } from "./steering_examples";
import { assertClose } from "./close";

/** A robot that is turned to the left, seen by a camera that looks along y of the world. */
const BASE_FROM_WORLD = new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), -Math.PI / 2);
const EYE = new Quaternion().setFromRotationMatrix(
  new Matrix4().lookAt(new Vector3(0, -1, 0), new Vector3(), new Vector3(0, 0, 1)),
);
const TIP = new Quaternion().setFromAxisAngle(new Vector3(1, 0, 0), Math.PI);

function velocity(frame: FrameName, deflection: Partial<typeof NO_DEFLECTION>, speed = 1): { linear: number[]; angular: number[] } {
  const axes = axesOf(frame, { baseFromWorld: BASE_FROM_WORLD, worldFromEye: EYE, baseFromTip: TIP });
  const { linear, angular } = tipVelocity(axes!, { ...NO_DEFLECTION, ...deflection }, speed);
  return { linear: linear.toArray(), angular: angular.toArray() };
}

test("in the view, right, forward and up are where the operator sees them", () => {
  // Right of the view is x of the world, which is -y of the turned base.
  assertClose(velocity("view", { right: 1 }).linear, [0, -0.25, 0], 1e-9);
  assertClose(velocity("view", { forward: 1 }).linear, [0.25, 0, 0], 1e-9);
  assertClose(velocity("view", { up: 1 }).linear, [0, 0, 0.25], 1e-9);
  assertClose(velocity("view", { yaw: 1 }).angular, [0, 0, 0.8], 1e-9);
});

test("in the base, forward is x; in the tool, forward is z", () => {
  assertClose(velocity("base", { forward: 1 }).linear, [0.25, 0, 0], 1e-9);
  assertClose(velocity("base", { right: 1 }).linear, [0, -0.25, 0], 1e-9);
  // The tool points down.
  assertClose(velocity("tool", { forward: 1 }).linear, [0, 0, -0.25], 1e-9);
  assertClose(velocity("tool", { up: 1 }).linear, [0, 0.25, 0], 1e-9);
  // Nose up: what points forward rotates toward up.
  const { angular } = velocity("base", { pitch: 1 });
  const tipped = new Vector3(1, 0, 0).applyAxisAngle(new Vector3(...(angular as [number, number, number])).normalize(), 0.1);
  assert.ok(tipped.z > 0.05);
});

test("diagonals are not faster, and the speed scales all", () => {
  const { linear } = velocity("base", { forward: 1, right: 1, up: 1 }, 0.5);
  assertClose([Math.hypot(...linear)], [0.125], 1e-9);
});

test("without the pose of the robot, the axes of the view are unknown, the others are not", () => {
  const rotations = { baseFromWorld: null, worldFromEye: EYE, baseFromTip: TIP };
  assert.equal(axesOf("view", rotations), null);
  assert.ok(axesOf("tool", rotations) && axesOf("base", rotations));
});

test("one joint is jogged, and goals stay within the limits", () => {
  assert.deepEqual(jointVelocities(ARM.joints, 1, -1, 0.5), [0, -0.25]);
  assert.deepEqual(movedJoints(ARM.joints, [0.9, -5], [1, -1], 0.5), [1, -5.5]);
  assert.deepEqual(movedJoints(ARM.joints, [0, 0.4], [-1, 1], 2), [-1, 0.5]);
});

test("opposite keys cancel, and unknown keys do nothing", () => {
  assert.deepEqual(deflectionOfKeys(["KeyW", "KeyS", "KeyP"]), NO_DEFLECTION);
  assert.deepEqual(deflectionOfKeys(["KeyA", "ArrowLeft"]), { ...NO_DEFLECTION, right: -1, yaw: 1 });
});

const RELEASED = Array.from({ length: 17 }, () => ({ pressed: false, value: 0 }));

function pad(axes: number[], pressed: Record<number, number>): ReturnType<typeof padInput> {
  const buttons = RELEASED.map((button, ix) => (ix in pressed ? { pressed: true, value: pressed[ix]! } : button));
  return padInput({ mapping: "standard", axes, buttons });
}

test("a gamepad moves only while a trigger is pulled, and stops without one", () => {
  assert.equal(pad([1, 0, 0, 0], {})?.isHeld, false);
  assert.equal(pad([1, 0, 0, 0], { 7: 0.2 })?.isHeld, false);
  assert.equal(pad([1, 0, 0, 0], { 7: 0.8 })?.isHeld, true);
  assert.equal(pad([0, 0, 0, 0], { 0: 1 })?.isGo, false, "go without a trigger");
  assert.equal(pad([0, 0, 0, 0], { 0: 1, 6: 1 })?.isGo, true);
  assert.equal(pad([0, 0, 0, 0], { 1: 1 })?.isStop, true);
});

test("sticks that are pushed away move forward, within a dead zone not at all", () => {
  const input = pad([0.05, -1, 0, -1], { 7: 1, 12: 1, 5: 1 })!;
  assert.deepEqual(input.deflection, { right: 0, forward: 1, up: 1, pitch: 1, roll: 1, yaw: 0 });
  assert.equal(withoutDeadZone(Number.NaN), 0);
  assertClose([withoutDeadZone(-1), withoutDeadZone(0.56)], [-1, 0.5], 1e-9);
});

test("a gamepad of unknown layout is not used", () => {
  assert.equal(padInput({ mapping: "", axes: [1, 1], buttons: RELEASED }), null);
  assert.equal(padInput({ mapping: "standard", axes: [], buttons: [] })?.isHeld, false);
});

test("of several gamepads, the first one moves, and each one stops", () => {
  const buttons = (pressed: number): typeof RELEASED => RELEASED.map((button, ix) => (ix === pressed ? { pressed: true, value: 1 } : button));
  const [trigger, stop] = [6, 1].map((ix) => ({ mapping: "standard", axes: [], buttons: buttons(ix) }));
  const unknown = { mapping: "", axes: [], buttons: buttons(1) };
  assert.equal(firstPad([null, unknown]), null);
  const first = firstPad([null, unknown, trigger!, stop!])!;
  assert.deepEqual([first.ix, first.input.isHeld, first.input.isStop], [2, true, true]);
  assert.deepEqual(firstPad([stop!, trigger!])?.input.isHeld, false);
});
