// The one place where three.js cameras (x right, y up, z backward) and ours (x right, y down, z forward) meet.
// Both worlds are the same: right-handed, z up, meters.

import { Matrix4, type PerspectiveCamera } from "three";
import type { Pinhole } from "./protocol";

/** Maps our camera's axes to those of a three.js camera; it is its own inverse. */
const THREE_FROM_OURS = new Matrix4().makeScale(1, -1, -1);

/** Pose of a three.js camera as 16 numbers, row major, in our convention. */
export function poseOfThreeCamera(camera: PerspectiveCamera): number[] {
  camera.updateMatrixWorld();
  const worldFromOurs = camera.matrixWorld.clone().multiply(THREE_FROM_OURS);
  return worldFromOurs.transpose().toArray();
}

/** Matrix of a pose of ours; it maps points with x right, y down, z forward to the world. */
export function worldFromCamera(rowMajor: number[]): Matrix4 {
  return new Matrix4().fromArray(rowMajor).transpose();
}

/** Lens of a three.js camera for a picture of this size: square pixels, principal point in the middle. */
export function pinholeOfThreeCamera(camera: PerspectiveCamera, [width, height]: [number, number]): Pinhole {
  const halfAngle = (camera.fov * Math.PI) / 360;
  // The aspect of a size in whole pixels differs a little from the window's; both directions keep the window's edges.
  const focalY = (0.5 * height) / Math.tan(halfAngle);
  const focalX = (0.5 * width) / (Math.tan(halfAngle) * camera.aspect);
  return { kind: "pinhole", focal_px: [focalX, focalY], principal_px: [0.5 * width, 0.5 * height] };
}
