import assert from "node:assert/strict";
import { test } from "node:test";
import { PerspectiveCamera, Vector3 } from "three";
import { pinholeOfThreeCamera, poseOfThreeCamera, worldFromCamera } from "../src/view/convention";
import { assertClose } from "./close";

test("the pose of a three.js camera has x right, y down, z forward", () => {
  const camera = new PerspectiveCamera();
  camera.up.set(0, 0, 1);
  camera.position.set(3, 0, 1);
  camera.lookAt(0, 0, 1);
  const pose = poseOfThreeCamera(camera);
  // Looking along -x with z up: right is world y, down is world -z, forward is world -x.
  assertClose(pose, [0, 0, -1, 3, 1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0, 1], 1e-12);
});

test("a pose maps points in front of the camera to the world", () => {
  const pose = [0, 0, -1, 3, 1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0, 1];
  // 0.5 m to the right, 0.25 m down, 2 m ahead.
  const point = new Vector3(0.5, 0.25, 2).applyMatrix4(worldFromCamera(pose));
  assertClose(point.toArray(), [1, 0.5, 0.75], 1e-12);
});

test("the pinhole keeps the field of view of the window in both directions", () => {
  const camera = new PerspectiveCamera(90, 4 / 3);
  const pinhole = pinholeOfThreeCamera(camera, [640, 480]);
  assert.equal(pinhole.kind, "pinhole");
  assertClose(pinhole.focal_px, [240, 240], 1e-9);
  assertClose(pinhole.principal_px, [320, 240], 0);
  // A picture that is a pixel wider shows the same part of the scene.
  const wider = pinholeOfThreeCamera(camera, [641, 480]);
  assertClose(wider.focal_px, [240.375, 240], 1e-9);
  assertClose(wider.principal_px, [320.5, 240], 0);
});
