import assert from "node:assert/strict";
import { test } from "node:test";
import { Matrix4, PerspectiveCamera, Quaternion, Vector3 } from "three";
import { depthRange, lensAround, lensOfProjection, motionBetween } from "../src/headset/eye_lens";
import { followed, HandClutch, type HandPose } from "../src/headset/hand_clutch";

const pose = (x: number, degrees = 0): HandPose => ({
  position: new Vector3(x, 0, 0),
  rotation: new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), (degrees * Math.PI) / 180),
});

/** A clutch whose tip is at x = 10, and what it does. */
function recorded(): { clutch: HandClutch; calls: string[] } {
  const calls: string[] = [];
  const clutch = new HandClutch({
    begin: () => {
      calls.push("begin");
      return pose(10);
    },
    move: (tip) => calls.push(`move ${tip.position.x.toFixed(2)}`),
    end: () => calls.push("end"),
    interrupt: (reason) => calls.push(`interrupt: ${reason}`),
  });
  return { clutch, calls };
}

test("the tip makes the motions of the hand from where it is", () => {
  const { clutch, calls } = recorded();
  clutch.update(pose(1), false);
  clutch.update(pose(1.5), true);
  clutch.update(pose(1.7), true);
  clutch.update(pose(1.8), false);
  clutch.update(pose(5), false);
  assert.deepEqual(calls, ["begin", "move 10.20", "end"]);
});

test("a second grip continues where the first one ended, without a jump", () => {
  const tip = pose(10, 20);
  const there = followed(tip, pose(0, 0), pose(1, 30));
  assert.ok(Math.abs(there.position.x - 11) < 1e-12);
  assert.ok(Math.abs(there.rotation.angleTo(pose(0, 50).rotation)) < 1e-6);
  const again = followed(there, pose(7, 90), pose(7, 90));
  assert.ok(again.position.distanceTo(there.position) < 1e-12 && again.rotation.angleTo(there.rotation) < 1e-6);
});

test("a hand that is lost opens the clutch, which a held trigger does not close again", () => {
  const { clutch, calls } = recorded();
  clutch.update(pose(1), true);
  clutch.update(null, true);
  clutch.update(null, false);
  assert.deepEqual(calls, ["begin", "interrupt: tracking of the hand was lost", "end"]);
  clutch.update(pose(9), true);
  assert.ok(!clutch.isClosed, "the trigger was never seen open");
  clutch.update(pose(9), false);
  clutch.update(pose(9), true);
  assert.ok(clutch.isClosed);
});

test("an interruption needs a new press", () => {
  const { clutch, calls } = recorded();
  clutch.update(pose(1), true);
  clutch.open("the headset was recentered");
  clutch.update(pose(2), true);
  assert.deepEqual(calls, ["begin", "interrupt: the headset was recentered", "end"]);
  clutch.open("again");
  assert.equal(calls.length, 3, "an open clutch has nothing to interrupt");
});

test("a trigger that had another meaning must be pulled again", () => {
  const { clutch, calls } = recorded();
  clutch.ignore(true);
  clutch.update(pose(1), true);
  assert.deepEqual(calls, []);
});

test("an arm that does not follow is not moved", () => {
  const calls: string[] = [];
  const clutch = new HandClutch({
    begin: () => null,
    move: () => calls.push("move"),
    end: () => calls.push("end"),
    interrupt: () => calls.push("interrupt"),
  });
  clutch.update(pose(1), true);
  clutch.update(pose(2), true);
  clutch.update(pose(2), false);
  assert.deepEqual(calls, []);
});

test("the lens of an eye agrees with the projection of WebGL, also if it is not centered", () => {
  const camera = new PerspectiveCamera(80, 1.1, 0.05, 300);
  camera.setViewOffset(2000, 1800, 300, 150, 1500, 1600); // Not symmetric.
  camera.updateProjectionMatrix();
  const [width, height] = [640, 480] as const;
  const lens = lensOfProjection(camera.projectionMatrix, [width, height]);
  const inCamera = new Vector3(0.3, -0.2, -1.7);
  const ndc = inCamera.clone().applyMatrix4(camera.projectionMatrix);
  const expected = [0.5 * width * (1 + ndc.x), 0.5 * height * (1 - ndc.y)];
  // fieldrig's camera has y down and z forward.
  const [x, y, z] = [inCamera.x, -inCamera.y, -inCamera.z];
  const px = [(lens.focalPx[0] * x) / z + lens.principalPx[0], (lens.focalPx[1] * y) / z + lens.principalPx[1]];
  for (const [axis, value] of px.entries()) assert.ok(Math.abs(value - expected[axis]!) < 1e-9, `${px} instead of ${expected}`);
  const [near, far] = depthRange(camera.projectionMatrix);
  assert.ok(Math.abs(near - 0.05) < 1e-9 && Math.abs(far - 300) < 1e-6);
});

test("one lens contains what both eyes see", () => {
  const left = { sizePx: [100, 100], focalPx: [50, 50], principalPx: [70, 50] } as const;
  const right = { sizePx: [100, 100], focalPx: [50, 50], principalPx: [30, 55] } as const;
  const copy = ({ sizePx, focalPx, principalPx }: typeof left | typeof right) => ({
    sizePx: [...sizePx] as [number, number],
    focalPx: [...focalPx] as [number, number],
    principalPx: [...principalPx] as [number, number],
  });
  const { sizePx, focalPx, principalPx } = lensAround([copy(left), copy(right)], 100);
  assert.deepEqual(sizePx, [280, 220]);
  assert.deepEqual(focalPx, [100, 100]);
  assert.deepEqual(principalPx, [140, 110]);
});

test("motions are measured in meters and radians", () => {
  const a = new Matrix4().makeRotationX(0.2).setPosition(1, 2, 3);
  const b = a.clone().multiply(new Matrix4().makeRotationY(0.3)).setPosition(1, 2, 3.4);
  const { meters, rad } = motionBetween(a, b);
  assert.ok(Math.abs(meters - 0.4) < 1e-12 && Math.abs(rad - 0.3) < 1e-9);
});
