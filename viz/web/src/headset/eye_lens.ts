// The lens of an eye, in fieldrig's convention: pixels from the top left, x right, y down. This file has no DOM.

import { type Matrix4, Vector3 } from "three";

export interface EyeLens {
  sizePx: [number, number];
  focalPx: [number, number];
  principalPx: [number, number];
}

/** The lens of a projection matrix of WebGL in a viewport of this size. Headsets have lenses that are not centered. */
export function lensOfProjection({ elements }: Matrix4, [width, height]: readonly [number, number]): EyeLens {
  return {
    sizePx: [width, height],
    focalPx: [0.5 * width * elements[0]!, 0.5 * height * elements[5]!],
    principalPx: [0.5 * width * (1 - elements[8]!), 0.5 * height * (1 + elements[9]!)],
  };
}

/** Distances of the near and far plane of a projection matrix of WebGL. */
export function depthRange({ elements }: Matrix4): [near: number, far: number] {
  const [a, b] = [elements[10]!, elements[14]!];
  return [b / (a - 1), b / (a + 1)];
}

/** The centered lens, of this many pixels per unit of the tangent, that contains all that the eyes see. */
export function lensAround(lenses: readonly EyeLens[], pxPerTangent: number): EyeLens {
  const half = [0, 1].map((axis) => {
    const sides = lenses.flatMap(({ sizePx, focalPx, principalPx }) => [
      principalPx[axis]! / focalPx[axis]!,
      (sizePx[axis]! - principalPx[axis]!) / focalPx[axis]!,
    ]);
    return Math.max(1, Math.round(Math.max(...sides) * pxPerTangent));
  });
  const [x, y] = half as [number, number];
  return { sizePx: [2 * x, 2 * y], focalPx: [pxPerTangent, pxPerTangent], principalPx: [x, y] };
}

/** Angle between the axes of two rotations about any axis, and distance of two poses. */
export function motionBetween(a: Matrix4, b: Matrix4): { meters: number; rad: number } {
  const position = (matrix: Matrix4): Vector3 => new Vector3().setFromMatrixPosition(matrix);
  const trace = [0, 1, 2].reduce((sum, column) => sum + axisOf(a, column).dot(axisOf(b, column)), 0);
  return {
    meters: position(a).distanceTo(position(b)),
    rad: Math.acos(Math.min(1, Math.max(-1, 0.5 * (trace - 1)))),
  };
}

function axisOf(matrix: Matrix4, column: number): Vector3 {
  return new Vector3().setFromMatrixColumn(matrix, column).normalize();
}
