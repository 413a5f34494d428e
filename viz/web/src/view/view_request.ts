// The fields of a picture request that describe the view.

import { PerspectiveCamera } from "three";
import type { PathView } from "./camera_path";
import { pinholeOfThreeCamera, poseOfThreeCamera } from "./convention";
import type { Crop } from "./crop_box";
import type { View } from "../connection/render_scheduler";

/** The view of a camera in a picture of this size, of the model from a depth and in a box. */
export function viewOfCamera(camera: PerspectiveCamera, sizePx: [number, number], nearM: number, crop?: Crop): View {
  return {
    world_from_camera: poseOfThreeCamera(camera),
    size_px: sizePx,
    projection: pinholeOfThreeCamera(camera, sizePx),
    near_m: nearM,
    far_m: camera.far,
    crop, // Omitted from the message if undefined.
  };
}

/** A camera at a place on the camera path. All other properties are those of the present camera. */
export function cameraAlong(
  { position, target, fovDegrees }: PathView,
  [width, height]: [number, number],
  { up, far }: PerspectiveCamera,
): PerspectiveCamera {
  const camera = new PerspectiveCamera(fovDegrees, width / height, undefined, far);
  camera.up.copy(up);
  camera.position.copy(position);
  camera.lookAt(target);
  return camera;
}
