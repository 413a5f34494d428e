// Places the label of a measured line on the screen, beside the line and away from its points.

import type { Point, Rect } from "./handle_places";

/** Distance of a label from a point, pixels. */
const GAP_PX = 12;
/** Distance of a label from the middle of its line, pixels. */
const LINE_GAP_PX = 8;
/** A label that crosses its line is placed as if it were farther away by this, pixels. */
const CROSSING_PX = 30;

/** Center of a label of this size close to the middle of the line between two points, so that it covers none of `points`. Pixels. */
export function placeLabel(
  [from, to]: [Point, Point],
  size: { width: number; height: number },
  view: Rect,
  points: Point[],
): Point {
  const middle = { x: 0.5 * (from.x + to.x), y: 0.5 * (from.y + to.y) };
  // Beside the middle of the line and, if points are in the way there, beside the whole line.
  const [near, far] = [[0, 0], [Math.abs(to.x - from.x), Math.abs(to.y - from.y)]].map(([width, height], ix) => {
    const gap = ix === 0 ? LINE_GAP_PX : GAP_PX;
    const [x, y] = [0.5 * (width! + size.width) + gap, 0.5 * (height! + size.height) + gap];
    return [[0, -y], [0, y], [x, 0], [-x, 0], [x, -y], [-x, -y], [x, y], [-x, y]];
  }) as [[number, number][], [number, number][]];
  const candidates = [...near, ...far].map(([x, y]) => clamped({ x: middle.x + x, y: middle.y + y }, size, view));
  const isClear = (center: Point): boolean => points.every((point) => !covers(center, size, point));
  const crosses = (center: Point): boolean =>
    [0.1, 0.3, 0.5, 0.7, 0.9].some((share) => {
      const point = { x: from.x + share * (to.x - from.x), y: from.y + share * (to.y - from.y) };
      return distance(center, size, point) === 0;
    });
  const cost = (center: Point): number => distance(center, size, middle) + (crosses(center) ? CROSSING_PX : 0);
  return candidates.filter(isClear).sort((a, b) => cost(a) - cost(b))[0] ?? candidates[0]!;
}

/** Distance of a point from a label, pixels; 0 inside of it. */
export function distance(center: Point, size: { width: number; height: number }, point: Point): number {
  const beyond = (away: number, side: number): number => Math.max(0, Math.abs(away) - 0.5 * side);
  return Math.hypot(beyond(point.x - center.x, size.width), beyond(point.y - center.y, size.height));
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
