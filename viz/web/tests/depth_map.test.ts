import assert from "node:assert/strict";
import { test } from "node:test";
import { Matrix4, Ray, Vector3 } from "three";
import { PanoramaDepthMap, PictureDepthMap } from "../src/layers/depth_map";
import { type PosedDepth, pixelAt, surfacePoint } from "../src/view/surface_picker";
import { assertClose } from "./close";

/** A picture of 400 x 200 pixels with a depth map of 4 x 2, seen from (1, 2, 3) along world z. */
function posed(depth: number[]): PosedDepth {
  return {
    worldFromPicture: new Matrix4().makeTranslation(1, 2, 3),
    sizePx: [400, 200],
    focalPx: [200, 200],
    principalPx: [200, 100],
    depth: Float32Array.from(depth),
    depthSizePx: [4, 2],
  };
}

/** A wall at 2 m in the left half of the picture, and no surface in the right half. */
const LEFT_WALL = [2, 2, 0, 0, 2, 2, 0, 0];

test("points project onto the pixels that contain them", () => {
  const picture = posed(LEFT_WALL);
  // u = 200 * x / z + 200 of 400, in quarters; v likewise in halves.
  assert.deepEqual(pixelAt(picture, new Vector3(0.001, 0.001, 1)), [2, 1]);
  assert.deepEqual(pixelAt(picture, new Vector3(-0.001, -0.001, 1)), [1, 0]);
  assert.deepEqual(pixelAt(picture, new Vector3(-0.75, 0, 1)), [0, 1]);
  assert.equal(pixelAt(picture, new Vector3(1.01, 0, 1)), null);
  assert.equal(pixelAt(picture, new Vector3(0, -0.51, 1)), null);
  assert.equal(pixelAt(picture, new Vector3(0, 0, -1)), null);
});

test("the clearance in a picture is the distance along its axis to the surface", () => {
  const map = new PictureDepthMap(posed(LEFT_WALL));
  assertClose(map.origin.toArray(), [1, 2, 3], 0);
  assert.equal(map.isWithin(), false);
  assert.equal(map.nearestM, -Infinity);
  // 0.3 m to the left, 1.5 m ahead.
  assertClose([map.clearance(new Vector3(0.7, 2, 4.5))], [0.5], 1e-6);
  assertClose([map.clearance(new Vector3(0.7, 2, 5.25))], [-0.25], 1e-6);
  assert.equal(map.clearance(new Vector3(1.3, 2, 4.5)), Infinity, "no surface");
  assert.equal(map.clearance(new Vector3(1, 2, 2)), Infinity, "behind the camera");
});

test("the largest clearance considers the neighbors of the pixel", () => {
  const map = new PictureDepthMap(posed(LEFT_WALL));
  assert.equal(map.largestClearance(new Vector3(0.7, 2, 5.25)), Infinity, "the next pixel has no surface");
  // In the first column, all neighbors belong to the wall.
  assertClose([map.largestClearance(new Vector3(-0.5, 2, 5.25))], [-0.25], 1e-6);
});

test("a panorama has the depth of each direction", () => {
  const depth = new Float32Array(8 * 4).fill(3);
  depth[2 * 8 + 4] = 5; // Ahead.
  depth[2 * 8 + 6] = 1.5; // To the right.
  depth[3 * 8 + 4] = 0; // Below: no surface.
  const map = new PanoramaDepthMap(new Matrix4().makeTranslation(1, 2, 3), depth, [8, 4]);
  assert.ok(map.isComplete);
  assertClose([map.nearestM], [1.5], 0);
  const at = (x: number, y: number, z: number): Vector3 => new Vector3(1 + x, 2 + y, 3 + z);
  assertClose([map.clearance(at(0.5, 0.2, 2))], [5 - Math.hypot(0.5, 0.2, 2)], 1e-6);
  assertClose([map.clearance(at(2, 0.2, -0.5))], [1.5 - Math.hypot(2, 0.2, -0.5)], 1e-6);
  assert.equal(map.clearance(at(0.05, 2, 0.1)), Infinity);
  assert.equal(map.clearance(at(0, 0, 0)), Infinity);
});

test("directions of a panorama are weighted by their solid angle", () => {
  const panorama = (rows: number[]): PanoramaDepthMap => {
    const depth = rows.flatMap((depthM) => new Array<number>(8).fill(depthM));
    return new PanoramaDepthMap(new Matrix4(), Float32Array.from(depth), [8, 4]);
  };
  // Half of the pixels are close each time; those around the horizon cover more of the sphere.
  assert.ok(panorama([9, 1, 1, 9]).isWithin(2));
  assert.ok(!panorama([1, 9, 9, 1]).isWithin(2));
  assert.ok(!panorama([0, 0, 0, 0]).isWithin(2), "no surface is not a close one");
});

test("a ray ends at the surface of the picture, from any viewpoint", () => {
  const picture = posed(new Array<number>(8).fill(2));
  const hit = (origin: [number, number, number], direction: [number, number, number]): number[] | undefined =>
    surfacePoint(new Ray(new Vector3(...origin), new Vector3(...direction).normalize()), picture, 0.1, 100)?.toArray();
  // The wall is at world z = 5. A search step is 2 % of the distance, halved 12 times.
  assertClose(hit([1, 2, 3], [0, 0, 1])!, [1, 2, 5], 1e-4);
  assertClose(hit([2, 2, 3], [-0.25, 0, 1])!, [1.5, 2, 5], 1e-4);
  assert.equal(hit([1, 2, 3], [0, 0, -1]), undefined, "away from the wall");
  assert.equal(hit([1, 2, 3], [1, 0, 0]), undefined, "outside of the picture");
});

test("a ray passes where the picture has no surface", () => {
  const ray = new Ray(new Vector3(1, 2, 3), new Vector3(0.2, 0, 1).normalize());
  assert.equal(surfacePoint(ray, posed(LEFT_WALL), 0.1, 100), null);
});
