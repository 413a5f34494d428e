import assert from "node:assert/strict";
import { test } from "node:test";
import { PerspectiveCamera, Quaternion, Raycaster, type Ray, Vector2, Vector3 } from "three";
import { Drag, type Handle, HANDLES, nearestOutline, outline } from "../src/steering/gizmo_drag";
import { assertClose } from "./close";
import type { Pose } from "../src/steering/pose";

const START: Pose = { position: new Vector3(0.2, 0, 0.3), rotation: new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), 0.4) };

/** A camera that looks at the hand from the front, from above, and from the side. */
const CAMERA = new PerspectiveCamera(50, 1.5, 0.01, 100);
CAMERA.up.set(0, 0, 1);
CAMERA.position.set(1.5, -2, 1.2);
CAMERA.lookAt(START.position);
CAMERA.updateMatrixWorld(true);

function rayAt(point: Vector3, camera = CAMERA): Ray {
  const { x, y } = point.clone().project(camera);
  const raycaster = new Raycaster();
  raycaster.setFromCamera(new Vector2(x, y), camera);
  return raycaster.ray;
}

function drag(handle: Handle, from: Vector3, axes = new Quaternion(), camera = CAMERA): Drag {
  return new Drag(handle, START, axes, camera.getWorldDirection(new Vector3()), rayAt(from, camera));
}

function at(x: number, y: number, z: number): Vector3 {
  return START.position.clone().add(new Vector3(x, y, z));
}

test("an arrow follows the pointer along its axis only, without a jump at the press", () => {
  const moved = drag({ kind: "move", axis: 0 }, at(0.1, 0, 0));
  assertClose(moved.to(rayAt(at(0.1, 0, 0))).position.toArray(), START.position.toArray(), 1e-6);
  const { position, rotation } = moved.to(rayAt(at(0.35, 0, 0)));
  assertClose(position.toArray(), at(0.25, 0, 0).toArray(), 1e-6);
  assert.ok(rotation.angleTo(START.rotation) < 1e-9);
  // A pointer beside the axis moves along it, too.
  const [, y, z] = moved.to(rayAt(at(0.2, 0.1, 0.05))).position.toArray();
  assertClose([y!, z!], [START.position.y, START.position.z], 1e-9);
});

test("an arrow of turned axes moves along the turned axis", () => {
  const axes = new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), Math.PI / 2);
  const { position } = drag({ kind: "move", axis: 0 }, at(0, 0.1, 0), axes).to(rayAt(at(0, 0.3, 0)));
  assertClose(position.toArray(), at(0, 0.2, 0).toArray(), 1e-6);
});

test("the ball moves parallel to the screen", () => {
  const right = new Vector3(1, 0, 0).transformDirection(CAMERA.matrixWorld).multiplyScalar(0.15);
  const { position } = drag({ kind: "plane" }, START.position).to(rayAt(START.position.clone().add(right)));
  assertClose(position.toArray(), START.position.clone().add(right).toArray(), 1e-6);
});

test("a ring turns the hand by the angle of the pointer, also by more than a whole turn", () => {
  const onRing = (angle: number): Vector3 => at(0.2 * Math.cos(angle), 0.2 * Math.sin(angle), 0);
  const turning = drag({ kind: "turn", axis: 2 }, onRing(0));
  let turned = START;
  for (let angle = 0; angle <= 7.01; angle += 0.5) turned = turning.to(rayAt(onRing(angle)));
  const expected = new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), 7).multiply(START.rotation);
  assert.ok(turned.rotation.angleTo(expected) < 1e-6);
  assertClose(turned.position.toArray(), START.position.toArray(), 1e-12);
});

test("a ring that is seen from its edge follows its tangent", () => {
  const side = new PerspectiveCamera(50, 1, 0.01, 100);
  side.up.set(0, 0, 1);
  side.position.copy(at(0, -2, 0));
  side.lookAt(START.position);
  side.updateMatrixWorld(true);
  const turning = drag({ kind: "turn", axis: 0 }, at(0, -0.2, 0), new Quaternion(), side);
  assert.ok(Number.isFinite(turning.to(rayAt(at(0, -0.2, 0.1), side)).rotation.w));
  const flat = drag({ kind: "turn", axis: 2 }, at(0.2, 0, 0), new Quaternion(), side);
  const { rotation } = flat.to(rayAt(at(0.25, 0, 0), side));
  assert.ok([rotation.x, rotation.y, rotation.z, rotation.w].every(Number.isFinite));
});

test("rays that hit nothing leave the hand where it is", () => {
  const moved = drag({ kind: "move", axis: 2 }, at(0, 0, 0.1));
  const away = rayAt(at(0, 0, 0.1)).clone();
  away.direction.negate();
  assertClose(moved.to(away).position.toArray(), START.position.toArray(), 1e-9);
});

test("the nearest handle within reach is pressed, and the first one of equals", () => {
  const lines = [[{ x: 50, y: 50 }], [{ x: 0, y: 0 }, { x: 100, y: 0 }], [{ x: 0, y: 0 }, { x: 0, y: 100 }], []];
  assert.equal(nearestOutline(lines, { x: 60, y: 4 }, 10), 1);
  assert.equal(nearestOutline(lines, { x: 4, y: 60 }, 10), 2);
  assert.equal(nearestOutline(lines, { x: 45, y: 52 }, 10), 0);
  assert.equal(nearestOutline(lines, { x: 0, y: 0 }, 10), 1);
  assert.equal(nearestOutline(lines, { x: 70, y: 70 }, 10), -1);
  assert.equal(nearestOutline([[]], { x: 0, y: 0 }, 10), -1, "outlines behind the viewer");
});

test("there are a ball, three arrows and three rings, around the hand", () => {
  assert.equal(HANDLES.length, 7);
  for (const handle of HANDLES) {
    const points = outline(handle);
    assert.ok(points.every((point) => point.length() < 1.2), handle.kind);
    if (handle.kind === "turn") assert.ok(points.every((point) => Math.abs(point.getComponent(handle.axis)) < 1e-12));
  }
});
