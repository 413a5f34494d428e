// Places the label of a measured line on the screen, beside the line and away from its points.

import type { Point, Rect } from "./handle_places";

/** Distance of a label from a point, pixels. */
const GAP_PX = 12;

/** Center of a label of this size for the line between two points, so that it covers none of `points`. Pixels. */
export function placeLabel(
  [from, to]: [Point, Point],
  size: { width: number; height: number },
  view: Rect,
  points: Point[],
): Point {
  const middle = { x: 0.5 * (from.x + to.x), y: 0.5 * (from.y + to.y) };
  const length = Math.hypot(to.x - from.x, to.y - from.y);
  // The label is moved across the line, or upward if the direction of the line is undefined.
  const across = length > 0 ? { x: (from.y - to.y) / length, y: (to.x - from.x) / length } : { x: 0, y: -1 };
  const away = 0.5 * (Math.abs(across.x) * size.width + Math.abs(across.y) * size.height) + GAP_PX;
  const halfWidth = 0.5 * Math.abs(to.x - from.x) + 0.5 * size.width + GAP_PX;
  const halfHeight = 0.5 * Math.abs(to.y - from.y) + 0.5 * size.height + GAP_PX;
  const offsets = [
    { x: across.x * away, y: across.y * away },
    { x: -across.x * away, y: -across.y * away },
    { x: 0, y: -halfHeight },
    { x: 0, y: halfHeight },
    { x: -halfWidth, y: 0 },
    { x: halfWidth, y: 0 },
  ];
  const candidates = offsets.map((offset) => clamped({ x: middle.x + offset.x, y: middle.y + offset.y }, size, view));
  const isClear = (center: Point): boolean => points.every((point) => !covers(center, size, point));
  return candidates.find(isClear) ?? candidates[0]!;
}

/** Whether a label covers a point or is close to it. */
export function covers(center: Point, size: { width: number; height: number }, point: Point): boolean {
  return (
    Math.abs(point.x - center.x) < 0.5 * size.width + 0.5 * GAP_PX &&
    Math.abs(point.y - center.y) < 0.5 * size.height + 0.5 * GAP_PX
  );
}

function clamped({ x, y }: Point, { width, height }: { width: number; height: number }, view: Rect): Point {
  const within = (value: number, low: number, high: number): number => Math.max(low, Math.min(high, value));
  return {
    x: within(x, view.left + 0.5 * width, view.right - 0.5 * width),
    y: within(y, view.top + 0.5 * height, view.bottom - 0.5 * height),
  };
}
