// Keyframes in the order of their time.

import type { NumberedKeyframe } from "../connection/protocol";

/** The keyframes, the oldest first. */
export function byTime(keyframes: readonly NumberedKeyframe[]): NumberedKeyframe[] {
  return [...keyframes].sort((a, b) => a.stamp_nanos - b.stamp_nanos);
}

/** Index of the keyframe whose time is closest, in a list ordered by time; -1 if the list is empty. */
export function nearestInTime(ordered: readonly NumberedKeyframe[], nanos: number): number {
  const away = (ix: number): number => Math.abs(ordered[ix]!.stamp_nanos - nanos);
  let nearest = ordered.length - 1;
  for (let ix = 0; ix < ordered.length; ix += 1) if (away(ix) < away(nearest)) nearest = ix;
  return nearest;
}

/** A duration as on a stopwatch: minutes and seconds, and hours if there are any. */
export function stopwatchText(secs: number): string {
  const whole = Math.max(0, Math.floor(secs));
  const twoDigits = (value: number): string => String(value).padStart(2, "0");
  const minutes = Math.floor(whole / 60);
  const end = twoDigits(whole % 60);
  return minutes < 60 ? `${minutes}:${end}` : `${Math.floor(minutes / 60)}:${twoDigits(minutes % 60)}:${end}`;
}
