import assert from "node:assert/strict";
import { test } from "node:test";
import { Matrix4, Quaternion, Vector3 } from "three";
import { Chase, viewFromBehind, yawBetween } from "../src/view/chase";
import type { Viewpoint } from "../src/view/eye_guard";
import { lensDegrees, nextCamera, Ride } from "../src/view/ride";
import { assertClose } from "./close";

const FRAME_SECS = 1 / 60;

function pose(x: number, y: number, yawRad: number, pitchRad = 0): Matrix4 {
  return new Matrix4().makeRotationZ(yawRad).multiply(new Matrix4().makeRotationY(pitchRad)).setPosition(x, y, 0);
}

/** The view after some time with a frame, and how often it has moved. */
function after(chase: Chase, view: Viewpoint, frame: Matrix4, secs: number): { view: Viewpoint; nMoves: number } {
  let current = view;
  let nMoves = 0;
  for (let step = 0; step < secs / FRAME_SECS; step++) {
    const moved = chase.update(current, frame, FRAME_SECS);
    if (!moved) continue;
    current = moved;
    nMoves += 1;
  }
  return { view: current, nMoves };
}

const START: Viewpoint = { eye: new Vector3(-2, 0, 1), target: new Vector3(0, 0, 0.5) };

test("a chase moves and turns with the frame, smoothly, and then rests", () => {
  const chase = new Chase();
  assert.equal(chase.update(START, pose(0, 0, 0), FRAME_SECS), null, "it begins where it is");
  const frame = pose(3, 1, Math.PI / 2);
  const early = after(chase, START, frame, 0.1).view;
  assert.ok(early.target.x > 0.2 && early.target.x < 2.5, "on its way");
  const { view } = after(chase, early, frame, 5);
  // Behind the robot, which now looks along y.
  assertClose(view.eye.toArray(), [3, -1, 1], 5e-3);
  assertClose(view.target.toArray(), [3, 1, 0.5], 1e-3);
  assert.equal(after(chase, view, frame, 1).nMoves, 0, "the picture can become sharp");
});

test("a chase rests while the frame moves by less than the dead band, and ignores pitch", () => {
  const chase = new Chase();
  chase.update(START, pose(0, 0, 0), FRAME_SECS);
  for (const frame of [pose(0.015, 0, 0), pose(0, -0.015, 0.05), pose(0, 0.01, -0.05)]) {
    assert.equal(after(chase, START, frame, 1).nMoves, 0);
  }
  const { view } = after(chase, START, pose(0, 0, 0, 0.5), 5);
  assertClose(view.eye.toArray(), START.eye.toArray(), 1e-6);
});

test("a noisy frame does not keep the view in motion", () => {
  const chase = new Chase();
  chase.update(START, pose(0, 0, 0), FRAME_SECS);
  let view = after(chase, START, pose(1, 0, 0), 5).view;
  let nMoves = 0;
  for (let step = 0; step < 300; step++) {
    const moved = chase.update(view, pose(1 + 0.004 * Math.sin(step), 0, 0.002 * Math.cos(step)), FRAME_SECS);
    if (moved) nMoves += 1;
    view = moved ?? view;
  }
  assert.equal(nMoves, 0);
});

test("the yaw between two rotations is signed, and at most half a turn", () => {
  const yaw = (rad: number): Quaternion => new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), rad);
  for (const [from, to, expected] of [
    [0, 0.3, 0.3],
    [0.3, 0, -0.3],
    [3, -3, 2 * Math.PI - 6],
  ] as const) {
    assertClose([yawBetween(yaw(from), yaw(to))], [expected], 1e-9);
  }
});

test("a robot that was not in the picture is first seen from behind", () => {
  const { eye, target } = viewFromBehind(new Vector3(1, 2, 0.5), 1, Math.PI / 2);
  assertClose(target.toArray(), [1, 2, 0.5], 0);
  assert.ok(eye.y < 0.5 && Math.abs(eye.x - 1) < 1e-9 && eye.z > 1);
});

const CAMERA = {
  camera: "wrist",
  size_px: [640, 480] as [number, number],
  focal_px: [320, 320] as [number, number],
  principal_px: [320, 240] as [number, number],
  // At (1, 0, 2), looks down; the upper edge of its image is at +y.
  world_from_camera: [1, 0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 2, 0, 0, 0, 1],
};

test("a ride has the pose of the camera, and rests with it", () => {
  const ride = new Ride();
  const first = ride.update(CAMERA, () => 1.5, FRAME_SECS);
  assert.ok(first);
  assertClose(first.eye.toArray(), [1, 0, 2], 1e-9);
  assertClose(first.target.toArray(), [1, 0, 0.5], 1e-9);
  // The upper side of the picture, and what the view of three.js calls backward.
  assertClose(new Vector3(0, 1, 0).applyQuaternion(first.rotation).toArray(), [0, 1, 0], 1e-6);
  assertClose(new Vector3(0, 0, 1).applyQuaternion(first.rotation).toArray(), [0, 0, 1], 1e-6);
  assert.equal(ride.update(CAMERA, () => 1.5, FRAME_SECS), null);
  const moved = { ...CAMERA, world_from_camera: CAMERA.world_from_camera.map((value, ix) => (ix === 3 ? 1.2 : value)) };
  let eye = first.eye;
  for (let step = 0; step < 120; step++) eye = ride.update(moved, () => 1.5, FRAME_SECS)?.eye ?? eye;
  assertClose(eye.toArray(), [1.2, 0, 2], 1e-3);
});

test("the lens of a ride shows the whole image of the camera", () => {
  // 2 atan(240 / 320) from top to bottom, 2 atan(320 / 320) from left to right.
  assertClose([lensDegrees(CAMERA, 2)], [(2 * Math.atan(0.75) * 180) / Math.PI], 1e-9);
  assertClose([lensDegrees(CAMERA, 1)], [90], 1e-9);
  const shifted = { ...CAMERA, principal_px: [320, 280] as [number, number] };
  assertClose([lensDegrees(shifted, 2)], [(2 * Math.atan(280 / 320) * 180) / Math.PI], 1e-9);
});

test("the cameras take turns", () => {
  assert.equal(nextCamera([], null), null);
  assert.equal(nextCamera(["front", "rear"], null), "front");
  assert.equal(nextCamera(["front", "rear"], "front"), "rear");
  assert.equal(nextCamera(["front", "rear"], "rear"), "front");
  assert.equal(nextCamera(["front", "rear"], "gone"), "front");
});
