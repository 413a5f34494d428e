// Finds the point of the model's surface on a ray, from the depth of the newest picture.

import { type Matrix4, type Ray, Vector3 } from "three";

/** A depth map and its camera. */
export interface PosedDepth {
  worldFromPicture: Matrix4;
  sizePx: [number, number];
  focalPx: [number, number];
  principalPx: [number, number];
  depth: Float32Array;
  depthSizePx: [number, number];
}

const N_STEPS = 400;
/** Halvings of the step that contains the surface. A step is about 2 % of the distance. */
const N_HALVINGS = 12;
/** A ray that begins closer to the eye of the picture than this, relative to its near limit, passes one pixel only. */
const SAME_EYE = 0.01;
/** If a point is farther behind the surface than this, relative to its depth, the picture does not show what is there. */
const MAX_BEHIND = 0.08;
/** Minimum difference of depths at an edge, relative to the depth. */
const MIN_EDGE = 0.02;
/** At an edge, the depth changes by this factor more than beside it. On an oblique surface, it changes evenly. */
const EDGE_FACTOR = 3;

/** Pixels to try around a pixel without surface, the closest first: within 8 pixels of the window. */
const OFFSETS = Array.from({ length: 81 }, (_, ix) => [2 * ((ix % 9) - 4), 2 * (Math.floor(ix / 9) - 4)] as const)
  .filter(([x, y]) => Math.hypot(x, y) <= 8)
  .sort((a, b) => Math.hypot(...a) - Math.hypot(...b));

/**
 * The surface at a pixel or, because the model has small holes, at the closest pixel nearby that has one; null if there
 * is none.
 */
export function nearestSurface(surfaceAt: (x: number, y: number) => Vector3 | null, x: number, y: number): Vector3 | null {
  for (const [dx, dy] of OFFSETS) {
    const point = surfaceAt(x + dx, y + dy);
    if (point) return point;
  }
  return null;
}

/** The point of the surface that the picture, seen from the origin of the ray, shows on the ray; null if there is none. */
export function surfacePoint(ray: Ray, posed: PosedDepth, nearM: number, farM: number): Vector3 | null {
  const pictureFromWorld = posed.worldFromPicture.clone().invert();
  const inPicture = new Vector3();
  const pointAt = (distance: number): Vector3 => ray.at(distance, inPicture).applyMatrix4(pictureFromWorld);
  if (pointAt(0).length() < SAME_EYE * nearM) {
    const pixel = pixelAt(posed, pointAt(1));
    const depth = pixel ? unmixedDepth(posed, pixel) : 0;
    return depth > 0 ? ray.at(depth / inPicture.z, new Vector3()) : null;
  }
  /** Depth of the point behind the surface, meters; not positive in front of it or without a surface. */
  const behindM = (distance: number): number => {
    const surface = depthAt(posed, pointAt(distance));
    return surface > 0 ? inPicture.z - surface : 0;
  };
  let before = nearM;
  let wasBehind = behindM(before) > 0;
  for (let step = 1; step <= N_STEPS; step++) {
    // Steps grow with the distance.
    const distance = nearM * (farM / nearM) ** (step / N_STEPS);
    const isBehind = behindM(distance) > 0;
    if (isBehind !== wasBehind) {
      let after = distance;
      for (let halving = 0; halving < N_HALVINGS; halving++) {
        const middle = 0.5 * (before + after);
        if (behindM(middle) > 0 === isBehind) after = middle;
        else before = middle;
      }
      // Otherwise, the ray passes the edge of a surface.
      const behind = isBehind ? after : before;
      if (behindM(behind) < MAX_BEHIND * inPicture.z) return ray.at(behind, new Vector3());
    }
    wasBehind = isBehind;
    before = distance;
  }
  return null;
}

/**
 * Depth of a pixel; 0 if there is none. At the edge of a surface, a pixel can have a mean of the depths of two surfaces,
 * at which there is nothing. Such a pixel gets the depth of the surface that has the larger share in it.
 */
function unmixedDepth({ depth, depthSizePx: [width, height] }: PosedDepth, [x, y]: [number, number]): number {
  const at = (column: number, row: number): number =>
    column >= 0 && row >= 0 && column < width && row < height ? (depth[row * width + column] ?? 0) : 0;
  const own = at(x, y);
  for (const [dx, dy] of [[1, 0], [0, 1]] as const) {
    const [first, before, after, last] = [-2, -1, 1, 2].map((step) => at(x + step * dx, y + step * dy)) as [number, number, number, number];
    const [down, up] = [own - before, after - own];
    const edge = Math.min(Math.abs(down), Math.abs(up));
    const beside = Math.max(Math.abs(before - first), Math.abs(last - after));
    if (before * after > 0 && down * up > 0 && edge > MIN_EDGE * own && edge > EDGE_FACTOR * beside) {
      return edge === Math.abs(down) ? before : after;
    }
  }
  return own;
}

/** Depth of the pixel onto which a point projects; 0 if there is none. */
function depthAt(posed: PosedDepth, inPicture: Vector3): number {
  const pixel = pixelAt(posed, inPicture);
  return pixel ? (posed.depth[pixel[1] * posed.depthSizePx[0] + pixel[0]] ?? 0) : 0;
}

/** The pixel of the depth map onto which a point projects; null if it lies outside. */
export function pixelAt(posed: PosedDepth, inPicture: Vector3): [number, number] | null {
  if (inPicture.z <= 0) return null;
  const uv = [inPicture.x, inPicture.y].map(
    (value, axis) =>
      ((posed.focalPx[axis]! * value) / inPicture.z + posed.principalPx[axis]!) / posed.sizePx[axis]!,
  );
  if (uv.some((value) => value < 0 || value >= 1)) return null;
  return uv.map((value, axis) => Math.floor(value * posed.depthSizePx[axis]!)) as [number, number];
}
