import assert from "node:assert/strict";
import { test } from "node:test";
import { Matrix4, Ray, Vector3 } from "three";
import { nearestSurface, type PosedDepth, surfacePoint } from "../src/view/surface_picker";
import { assertClose } from "./close";

const SIDE_PX = 40;
const NEAR_M = 0.01;
const FAR_M = 50;

/** A picture from the origin along z, with a field of view of 90 degrees. */
function picture(depthAt: (x: number, y: number) => number): PosedDepth {
  const depth = Float32Array.from({ length: SIDE_PX ** 2 }, (_, ix) => depthAt(ix % SIDE_PX, Math.floor(ix / SIDE_PX)));
  return {
    worldFromPicture: new Matrix4(),
    sizePx: [SIDE_PX, SIDE_PX],
    focalPx: [SIDE_PX / 2, SIDE_PX / 2],
    principalPx: [SIDE_PX / 2, SIDE_PX / 2],
    depth,
    depthSizePx: [SIDE_PX, SIDE_PX],
  };
}

/** The ray through the middle of a pixel of the picture. */
function through(x: number, y: number): Ray {
  const [u, v] = [x, y].map((at) => (at + 0.5 - SIDE_PX / 2) / (SIDE_PX / 2)) as [number, number];
  return new Ray(new Vector3(), new Vector3(u, v, 1).normalize());
}

function depthOn(ray: Ray, posed: PosedDepth): number | null {
  return surfacePoint(ray, posed, NEAR_M, FAR_M)?.z ?? null;
}

test("from the eye of the picture, the point has the depth of its pixel", () => {
  const posed = picture((x) => (x < 20 ? 2 : 7));
  assertClose([depthOn(through(19, 10), posed)!, depthOn(through(20, 10), posed)!], [2, 7], 1e-6);
  const point = surfacePoint(through(5, 30), posed, NEAR_M, FAR_M)!;
  assertClose(point.toArray(), [2 * (-14.5 / 20), 2 * (10.5 / 20), 2], 1e-6);
});

test("a pixel at an edge with a mean depth belongs to one of the two surfaces", () => {
  for (const [mixed, expected] of [[3, 2], [6, 7]] as const) {
    const posed = picture((x) => (x < 20 ? 2 : x === 20 ? mixed : 7));
    assertClose([depthOn(through(20, 10), posed)!], [expected], 1e-6);
    const turned = picture((_, y) => (y < 20 ? 7 : y === 20 ? mixed : 2));
    assertClose([depthOn(through(10, 20), turned)!], [expected], 1e-6);
  }
});

test("thin objects, gaps and oblique surfaces keep their depths", () => {
  const thin = picture((x) => (x === 20 ? 2 : 7));
  assertClose([depthOn(through(20, 10), thin)!], [2], 1e-6);
  const gap = picture((x) => (x === 20 ? 7 : 2));
  assertClose([depthOn(through(20, 10), gap)!], [7], 1e-6);
  const oblique = picture((x) => 1 / (0.6 - 0.014 * x));
  for (const x of [2, 20, 38]) assertClose([depthOn(through(x, 10), oblique)!], [1 / (0.6 - 0.014 * x)], 1e-5);
});

test("a hole has no point, but the closest pixel with a surface has one", () => {
  const posed = picture((x, y) => (Math.hypot(x - 20, y - 20) < 3 ? 0 : 2));
  assert.equal(depthOn(through(20, 20), posed), null);
  const surfaceAt = (x: number, y: number): Vector3 | null => surfacePoint(through(x, y), posed, NEAR_M, FAR_M);
  assertClose([nearestSurface(surfaceAt, 20, 20)!.z], [2], 1e-6);
  const near = nearestSurface(surfaceAt, 22, 20)!;
  assert.ok(near.x > 0, "the closest one is on the right");
  const empty = picture(() => 0);
  assert.equal(nearestSurface((x, y) => surfacePoint(through(x, y), empty, NEAR_M, FAR_M), 20, 20), null);
});

test("from another eye, the ray ends at the surface, and not behind an edge", () => {
  // A wall at 2 m on the left, and a wall at 7 m behind it.
  const posed = picture((x) => (x < 20 ? 2 : 7));
  const eye = new Vector3(1, 0, 0);
  const toward = (point: Vector3): Ray => new Ray(eye, point.clone().sub(eye).normalize());
  assertClose(surfacePoint(toward(new Vector3(-0.5, 0.1, 2)), posed, NEAR_M, FAR_M)!.toArray(), [-0.5, 0.1, 2], 0.02);
  // Behind the near wall, the picture shows nothing: the ray passes its edge at a depth of 4 m.
  assert.equal(surfacePoint(toward(new Vector3(-0.75, 0.1, 7)), posed, NEAR_M, FAR_M), null);
  assertClose(surfacePoint(toward(new Vector3(0.5, 0.1, 7)), posed, NEAR_M, FAR_M)!.toArray(), [0.5, 0.1, 7], 0.05);
});
