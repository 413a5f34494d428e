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

/** The first point on the ray that lies behind the surface in the picture's depth map; null if there is none. */
export function surfacePoint(ray: Ray, posed: PosedDepth, nearM: number, farM: number): Vector3 | null {
  const pictureFromWorld = posed.worldFromPicture.clone().invert();
  const inPicture = new Vector3();
  const isBehindSurface = (distance: number): boolean => {
    ray.at(distance, inPicture).applyMatrix4(pictureFromWorld);
    const surface = depthAt(posed, inPicture);
    return surface > 0 && inPicture.z >= surface;
  };
  let before = nearM;
  for (let step = 1; step <= N_STEPS; step++) {
    // Steps grow with the distance.
    const distance = nearM * (farM / nearM) ** (step / N_STEPS);
    if (isBehindSurface(distance)) {
      let behind = distance;
      for (let halving = 0; halving < N_HALVINGS; halving++) {
        const middle = 0.5 * (before + behind);
        if (isBehindSurface(middle)) behind = middle;
        else before = middle;
      }
      return ray.at(behind, new Vector3());
    }
    before = distance;
  }
  return null;
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
