// The goal of a base on the floor: its position and heading, and whether it can be sent. This file has no DOM.

import type { Area, Intent, Point } from "./messages";

/** A drag that is shorter does not turn the goal, meters. */
const MIN_DRAG_M = 0.1;

/** x and y on the floor, meters. */
export type Place = readonly [x: number, y: number];

/** The goal of a drag from its place in the direction that the base should face. A short drag keeps the heading. */
export function draggedGoal(from: Place, to: Place, heading: number): Point {
  const [x, y] = [to[0] - from[0], to[1] - from[1]];
  return [from[0], from[1], Math.hypot(x, y) < MIN_DRAG_M ? heading : Math.atan2(y, x)];
}

export function goalIntent([x_m, y_m, heading_rad]: Point): Intent {
  return { kind: "base_goal", x_m, y_m, heading_rad };
}

/** Whether a base may be sent to a goal. */
export function isInArea([x, y]: Point, area: Area | null): boolean {
  if (!area) return true;
  const [x0, y0, x1, y1] = area;
  return x >= x0 && x <= x1 && y >= y0 && y <= y1;
}
