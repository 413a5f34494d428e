// Keyframes in the order of their time.

import type { NumberedKeyframe } from "../connection/protocol";

/** The keyframes, the oldest first. */
export function byTime(keyframes: readonly NumberedKeyframe[]): NumberedKeyframe[] {
  return [...keyframes].sort((a, b) => a.stamp_nanos - b.stamp_nanos || a.id - b.id);
}

/** Index of the keyframe whose time is closest, in a list ordered by time; -1 if the list is empty. */
export function nearestInTime(ordered: readonly NumberedKeyframe[], nanos: number): number {
  const away = (ix: number): number => Math.abs(ordered[ix]!.stamp_nanos - nanos);
  let nearest = ordered.length - 1;
  for (let ix = 0; ix < ordered.length; ix += 1) if (away(ix) < away(nearest)) nearest = ix;
  return nearest;
}
