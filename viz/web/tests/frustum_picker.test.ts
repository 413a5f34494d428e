import assert from "node:assert/strict";
import { test } from "node:test";
import type { PosedCamera } from "../src/connection/protocol";
import type { View } from "../src/connection/render_scheduler";
import { pickFrustum } from "../src/layers/frustum_picker";

/** A camera at (x, 0, z) that looks along the world's z axis. */
function camera(name: string, x: number, z: number): PosedCamera {
  const world_from_camera = [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, z, 0, 0, 0, 1];
  return { camera: name, world_from_camera, size_px: [200, 100], focal_px: [100, 100], principal_px: [100, 50] };
}

/** A view from the origin along z; its pictures have half the size of the window. */
const VIEW: View = {
  world_from_camera: camera("view", 0, 0).world_from_camera,
  size_px: [400, 300],
  projection: { kind: "pinhole", focal_px: [200, 200], principal_px: [200, 150] },
  near_m: 0.1,
  far_m: 100,
  crop: undefined,
};
const CAMERAS = [camera("left", -1, 4), camera("right", 1, 4), camera("behind", 0, -4)];

const pick = (x: number, y: number): string | undefined => pickFrustum(CAMERAS, 1, VIEW, [800, 600], [x, y])?.camera;

test("a click on a line of a frustum picks its keyframe", () => {
  // The eye of the right camera is at (1, 0, 4): 50 px to the right of the picture's center, 100 px in the window.
  assert.equal(pick(500, 300), "right");
  assert.equal(pick(300, 300), "left");
  // Its left lower corner, at (0, 0.5, 5), is at (400, 340); so is the right lower corner of the left camera.
  assert.equal(pick(450, 322), "right");
});

test("a click beside all lines picks nothing, and so do cameras behind the view", () => {
  assert.equal(pick(500, 200), undefined);
  assert.equal(pickFrustum([CAMERAS[2]!], 1, VIEW, [800, 600], [400, 300]), null);
  assert.equal(pickFrustum([], 1, VIEW, [800, 600], [500, 300]), null);
});
