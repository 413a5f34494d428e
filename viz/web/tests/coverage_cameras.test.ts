import assert from "node:assert/strict";
import { test } from "node:test";
import { cameraToTurn, eyeFor } from "../src/panels/coverage_cameras";

const LENS = { size_px: [640, 480], focal_px: [400, 400], principal_px: [320, 240] } as {
  size_px: [number, number];
  focal_px: [number, number];
  principal_px: [number, number];
};

/** A camera at a position that looks horizontally at an angle to the x axis of world. */
function camera(name: string, [x, y, z]: [number, number, number], degrees: number) {
  const [cos, sin] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
  const world_from_camera = [sin, 0, cos, x, -cos, 0, sin, y, 0, -1, 0, z, 0, 0, 0, 1];
  return { camera: name, world_from_camera, ...LENS };
}

test("the camera to turn stays the same until another one needs much less turning", () => {
  const at = (front: number): string | undefined => {
    const cameras = [camera("front", [0, 0, 1], front), camera("rear", [0, 0, 1], front + 180)];
    return cameraToTurn(cameras, [5, 0, 1], previous)?.camera;
  };
  let previous: string | null = null;
  assert.equal(at(80), "front");
  previous = "front";
  assert.equal(at(100), "front", "the rear camera needs 20 degrees less");
  assert.equal(at(130), "rear", "the rear camera needs 80 degrees less");
  previous = "gone";
  assert.equal(at(100), "rear");
  assert.equal(cameraToTurn([], [5, 0, 1], "front"), null);
});

test("the eye is at the closest camera that has the place in its image", () => {
  const seeing = camera("far", [-3, 0, 1], 0);
  const beside = camera("beside", [0, 1, 1], 0);
  const behind = camera("behind", [2, 0, 1], 0);
  const place = [1, 0, 1] as const;
  assert.deepEqual(eyeFor([beside, behind, camera("farther", [-6, 0, 1], 0), seeing], place), [-3, 0, 1]);
  assert.deepEqual(eyeFor([behind, beside], place), [0, 1, 1]);
  assert.deepEqual(eyeFor([behind], place), [2, 0, 1]);
  assert.equal(eyeFor([], place), null);
});
