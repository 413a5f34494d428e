import assert from "node:assert/strict";
import { test } from "node:test";
import { Matrix4, Vector3 } from "three";
import { PanoramaDepthMap, PictureDepthMap } from "../src/layers/depth_map";
import { EyeGuard, type HitMesh, type Viewpoint } from "../src/view/eye_guard";
import { assertClose } from "./close";

const NEAR_M = 0.01;
/** The eye keeps 3 near planes away from surfaces, and moves in steps of a quarter of that. */
const MARGIN_M = 0.03;
const STEP_M = 0.25 * MARGIN_M;

const NO_MESH: HitMesh = () => null;

function guardOf(hitMesh: HitMesh): EyeGuard {
  const guard = new EyeGuard(hitMesh);
  guard.nearM = NEAR_M;
  return guard;
}

function at(x: number, y: number, z: number): Viewpoint {
  return { eye: new Vector3(x, y, z), target: new Vector3(x, y, z + 1) };
}

/** A wall that fills a picture with a field of view of 90 degrees. */
function wall(worldFromPicture: Matrix4, depthM: number): PictureDepthMap {
  const depth = new Float32Array(20 * 20).fill(depthM);
  const size: [number, number] = [200, 200];
  return new PictureDepthMap({
    worldFromPicture,
    sizePx: size,
    focalPx: [100, 100],
    principalPx: [100, 100],
    depth,
    depthSizePx: [20, 20],
  });
}

test("a motion ends in front of a known wall", () => {
  const guard = guardOf(NO_MESH);
  guard.jump(at(0, 0, 0), true);
  assert.equal(guard.see("main", wall(new Matrix4(), 2)), null);
  const eye = guard.limit(new Vector3(0, 0, 5), false);
  assertClose([eye.x, eye.y], [0, 0], 1e-9);
  assert.ok(eye.z <= 2 - MARGIN_M && eye.z > 2 - MARGIN_M - 2 * STEP_M, `the eye is at z = ${eye.z}`);
});

/** A wall at this y, in a coarse panorama from the origin. Everything else is 20 m away. */
function wallBeside(yM: number): PanoramaDepthMap {
  const [width, height] = [128, 64];
  const depth = Float32Array.from({ length: width * height }, (_, ix) => {
    const up = Math.sin(((Math.floor(ix / width) + 0.5) / height - 0.5) * Math.PI);
    return Math.min(20, up > 0 ? yM / up : Infinity);
  });
  return new PanoramaDepthMap(new Matrix4(), depth, [width, height]);
}

test("a motion ends in front of a wall that was seen at a small angle", () => {
  const wallM = 0.57;
  for (let alongM = 0.5; alongM < 3; alongM += 0.1) {
    const guard = guardOf(NO_MESH);
    guard.jump(at(0, 0, 0), true);
    guard.see("surroundings", wallBeside(wallM));
    guard.moved(at(alongM, 0, 0));
    const eye = guard.limit(new Vector3(alongM, 0.8, 0), false);
    assert.ok(eye.y > 0.1 && eye.y < wallM - NEAR_M, `at x = ${alongM}, the eye is at y = ${eye.y}`);
  }
});

test("a motion that stays in front of the wall is not changed", () => {
  const guard = guardOf(NO_MESH);
  guard.jump(at(0, 0, 0), true);
  guard.see("main", wall(new Matrix4(), 2));
  assertClose(guard.limit(new Vector3(0.2, 0.1, 1.5), false).toArray(), [0.2, 0.1, 1.5], 0);
});

test("without a map, nothing limits a motion, and forget removes the limits", () => {
  const guard = guardOf(NO_MESH);
  guard.jump(at(0, 0, 0), true);
  assertClose(guard.limit(new Vector3(0, 0, 5), false).toArray(), [0, 0, 5], 0);
  guard.see("main", wall(new Matrix4(), 2));
  guard.forget();
  assertClose(guard.limit(new Vector3(0, 0, 5), false).toArray(), [0, 0, 5], 0);
});

test("a sliding motion continues along the wall", () => {
  const guard = guardOf(NO_MESH);
  guard.jump(at(0, 0, 1.9), true);
  guard.see("main", wall(new Matrix4(), 2));
  const eye = guard.limit(new Vector3(0.5, 0, 2.4), true);
  assertClose([eye.x], [0.5], 1e-6);
  assert.ok(eye.z <= 2 - MARGIN_M, `the eye is at z = ${eye.z}`);
  const stopped = guard.limit(new Vector3(0.5, 0, 2.4), false);
  assert.ok(stopped.x < 0.1, `without sliding, the eye stops at x = ${stopped.x}`);
});

test("a motion ends in front of the mesh that the page draws", () => {
  const guard = guardOf((from, direction, maxM) => {
    const distance = (1 - from.z) / direction.z;
    return distance > 0 && distance <= maxM ? { distance, normal: new Vector3(0, 0, -1) } : null;
  });
  guard.jump(at(0, 0, 0), true);
  const eye = guard.limit(new Vector3(0, 0, 3), false);
  assert.ok(eye.z <= 1 - MARGIN_M && eye.z > 1 - MARGIN_M - 2 * STEP_M, `the eye is at z = ${eye.z}`);
});

test("the eye returns if a later picture shows that it has passed a wall", () => {
  const guard = guardOf(NO_MESH);
  guard.jump(at(0, 0, 0), true);
  guard.moved(at(0, 0, 3));
  // From z = 3, looking back along -z: the wall is 1 m away, at z = 2.
  const back = new Matrix4().makeRotationY(Math.PI).setPosition(0, 0, 3);
  const good = guard.see("main", wall(back, 1));
  assertClose(good!.eye.toArray(), [0, 0, 0], 0);
});

test("the eye does not return if the way is in front of all surfaces", () => {
  const guard = guardOf(NO_MESH);
  guard.jump(at(0, 0, 0), true);
  guard.moved(at(0, 0, 3));
  const back = new Matrix4().makeRotationY(Math.PI).setPosition(0, 0, 3);
  assert.equal(guard.see("main", wall(back, 4)), null);
});
