// Conversion between three.js cameras (x right, y up, z backward) and fieldrig cameras (x right, y down, z forward).
// The world is the same in both: right-handed, z up, meters. No other file converts.

import { Matrix4, type PerspectiveCamera, Quaternion, Vector3 } from "three";
import type { Pinhole } from "../connection/protocol";

/** Maps fieldrig camera axes to three.js camera axes; its own inverse. */
const THREE_FROM_OURS = new Matrix4().makeScale(1, -1, -1);

/** Pose of a three.js camera as 16 numbers, row major, in fieldrig's convention. */
export function poseOfThreeCamera(camera: PerspectiveCamera): number[] {
  camera.updateMatrixWorld();
  const worldFromOurs = camera.matrixWorld.clone().multiply(THREE_FROM_OURS);
  return worldFromOurs.transpose().toArray();
}

/** Matrix of a fieldrig pose; maps points with x right, y down, z forward to the world. */
export function worldFromCamera(rowMajor: number[]): Matrix4 {
  return new Matrix4().fromArray(rowMajor).transpose();
}

/** Pose of a three.js camera that sees what a fieldrig camera sees, from 16 numbers, row major. */
export function worldFromThreeCamera(rowMajor: number[]): Matrix4 {
  return worldFromCamera(rowMajor).multiply(THREE_FROM_OURS);
}

/** Pose of a three.js camera in fieldrig's convention, with the scale of the matrix, if it has one. */
export function cameraOfThree(worldFromThree: Matrix4): Matrix4 {
  return worldFromThree.clone().multiply(THREE_FROM_OURS);
}

/** A pose as 16 numbers, row major, without the scale of the matrix. */
export function rowMajorPose(worldFromCamera: Matrix4): number[] {
  const [position, rotation] = [new Vector3(), new Quaternion()];
  worldFromCamera.decompose(position, rotation, new Vector3());
  return new Matrix4().compose(position, rotation, new Vector3(1, 1, 1)).transpose().toArray();
}

/** Lens of a three.js camera for a picture of this size: square pixels, principal point in the center. */
export function pinholeOfThreeCamera(camera: PerspectiveCamera, [width, height]: [number, number]): Pinhole {
  const halfAngle = (camera.fov * Math.PI) / 360;
  // The aspect ratio of a size in whole pixels differs slightly from the window's. Separate focal lengths keep the
  // window's edges in both directions.
  const focalY = (0.5 * height) / Math.tan(halfAngle);
  const focalX = (0.5 * width) / (Math.tan(halfAngle) * camera.aspect);
  return { kind: "pinhole", focal_px: [focalX, focalY], principal_px: [0.5 * width, 0.5 * height] };
}
