// Orders of the keyframes: by time, by error, and by distance to a view.

import type { NumberedKeyframe } from "../connection/protocol";
import { byTime } from "./keyframe_times";

export type KeyframeOrder = "time" | "error";

/** Identifies a keyframe also after a reconnect, when a server may have other numbers. */
export function keyframeKey({ camera, stamp_nanos }: Pick<NumberedKeyframe, "camera" | "stamp_nanos">): string {
  return `${stamp_nanos} ${camera}`;
}

/**
 * The keyframes, the oldest or the worst first. `psnrOf` has the PSNR of the measured keyframes.
 * The other keyframes follow.
 */
export function orderedKeyframes(
  keyframes: readonly NumberedKeyframe[],
  order: KeyframeOrder,
  psnrOf: ReadonlyMap<string, number>,
): NumberedKeyframe[] {
  const ordered = byTime(keyframes);
  if (order === "time") return ordered;
  const psnr = (keyframe: NumberedKeyframe): number => psnrOf.get(keyframeKey(keyframe)) ?? Infinity;
  const isBefore = (a: number, b: number): number => (a === b ? 0 : a < b ? -1 : 1);
  return ordered.sort((a, b) => isBefore(psnr(a), psnr(b)));
}

/**
 * The keyframe `step` places after the shown keyframe. Beyond the ends, this is the first or the
 * last keyframe. A shown keyframe that has been removed meanwhile counts as between its neighbors
 * in time.
 */
export function neighborKeyframe(
  ordered: readonly NumberedKeyframe[],
  shown: NumberedKeyframe,
  step: number,
): NumberedKeyframe | undefined {
  const key = keyframeKey(shown);
  const ix = ordered.findIndex((keyframe) => keyframeKey(keyframe) === key);
  const later = ordered.findIndex((keyframe) => keyframe.stamp_nanos > shown.stamp_nanos);
  const after = later < 0 ? ordered.length : later;
  const wanted = ix >= 0 ? ix + step : step > 0 ? after + step - 1 : after + step;
  return ordered[Math.min(ordered.length - 1, Math.max(0, wanted))];
}

/**
 * The keyframe closest to a view. A distance of `radiusM` counts as much as an angle of 1 rad
 * between the viewing directions. Poses are 16 numbers, row major.
 */
export function nearestKeyframe(
  keyframes: readonly NumberedKeyframe[],
  worldFromCamera: readonly number[],
  radiusM: number,
): NumberedKeyframe | undefined {
  const distance = ({ world_from_camera: pose }: NumberedKeyframe): number => {
    const meters = Math.hypot(...[3, 7, 11].map((ix) => pose[ix]! - worldFromCamera[ix]!));
    const cosine = [2, 6, 10].reduce((sum, ix) => sum + pose[ix]! * worldFromCamera[ix]!, 0);
    return meters / radiusM + Math.acos(Math.min(1, Math.max(-1, cosine)));
  };
  let nearest: { keyframe: NumberedKeyframe; distance: number } | undefined;
  for (const keyframe of keyframes) {
    const away = distance(keyframe);
    if (!nearest || away < nearest.distance) nearest = { keyframe, distance: away };
  }
  return nearest?.keyframe;
}
