// Finds the keyframe whose frustum was clicked.

import { Matrix4, Vector3 } from "three";
import type { PosedCamera } from "../connection/protocol";
import type { View } from "../connection/render_scheduler";
import { worldFromCamera } from "../view/convention";
import { frustum } from "./overlays";

/** Lines can be hit from this distance, pixels of the window: about the accuracy of a finger. */
const REACH_PX = 10;

type Pixel = [number, number];

/** The keyframe with a line closest to a pixel of a window of this size; null if none is near it. */
export function pickFrustum<K extends PosedCamera>(
  keyframes: readonly K[],
  depthM: number,
  view: View,
  windowPx: Pixel,
  at: Pixel,
): K | null {
  const cameraFromWorld = worldFromCamera(view.world_from_camera).invert();
  let [best, bestPx]: [K | null, number] = [null, REACH_PX];
  for (const keyframe of keyframes) {
    const lines = frustum(keyframe, depthM).map((point) => pixelOf(point, cameraFromWorld, view, windowPx));
    for (let ix = 0; ix + 1 < lines.length; ix += 2) {
      const [from, to] = [lines[ix]!, lines[ix + 1]!];
      const away = from && to ? distanceToLine(at, from, to) : Infinity;
      if (away < bestPx) [best, bestPx] = [keyframe, away];
    }
  }
  return best;
}

/** Pixel of a point in world; null behind the near limit of the view. */
function pixelOf(point: Vector3, cameraFromWorld: Matrix4, view: View, windowPx: Pixel): Pixel | null {
  const { x, y, z } = new Vector3().copy(point).applyMatrix4(cameraFromWorld);
  if (z < view.near_m) return null;
  const { focal_px, principal_px } = view.projection;
  return [
    ((focal_px[0] * x) / z + principal_px[0]) * (windowPx[0] / view.size_px[0]),
    ((focal_px[1] * y) / z + principal_px[1]) * (windowPx[1] / view.size_px[1]),
  ];
}

function distanceToLine([x, y]: Pixel, [fromX, fromY]: Pixel, [toX, toY]: Pixel): number {
  const [dx, dy] = [toX - fromX, toY - fromY];
  const along = ((x - fromX) * dx + (y - fromY) * dy) / Math.max(dx * dx + dy * dy, 1e-9);
  const share = Math.min(1, Math.max(0, along));
  return Math.hypot(x - fromX - share * dx, y - fromY - share * dy);
}
