// Whether the model hides the robot, for example because the overview looks at a room from outside.

import { type Box3, Vector3 } from "three";

/**
 * Surfaces that are closer to a point of the robot than this, meters, may belong to the robot, or
 * to the floor or table below it.
 */
const MARGIN_M = 0.05;

/** Distance of the box from the eye if surfaces hide its center and the middles of its sides; otherwise null. */
export function hiddenDistanceM(
  box: Box3,
  eye: Vector3,
  surfaceToward: (point: Vector3) => Vector3 | null,
): number | null {
  if (box.isEmpty()) return null;
  const center = box.getCenter(new Vector3());
  const half = box.getSize(new Vector3()).multiplyScalar(0.5);
  const sides = [0, 1, 2].flatMap((axis) =>
    [-1, 1].map((sign) => center.clone().setComponent(axis, center.getComponent(axis) + sign * half.getComponent(axis))),
  );
  const isHidden = (point: Vector3): boolean => {
    const surface = surfaceToward(point);
    return surface !== null && surface.distanceTo(eye) < point.distanceTo(eye) - MARGIN_M;
  };
  return [center, ...sides].every(isHidden) ? Math.max(0, center.distanceTo(eye) - half.length()) : null;
}
