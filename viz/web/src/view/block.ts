// Says why the eye does not move on, or does not see the robot.

import type { Vector3 } from "three";

/**
 * What stopped the eye, or what hides the robot. The eye can be stopped by a surface, by space that
 * is not known yet, or by the shortest or longest distance to the target.
 */
export type Block =
  | { by: "surface" | "unknown space"; direction: Direction }
  | { by: "near end" | "far end" | "model before robot" };

/** Where the eye was about to go, in the view. */
type Direction = "ahead" | "behind" | "beside";

/** Motions within this angle of the line of sight go ahead or back. */
const MAX_ANGLE_RAD = Math.PI / 3;

/** What stops a motion of an eye that looks forward. */
export function blockOf(motion: Vector3, forward: Vector3, isSurface: boolean): Block {
  const angle = motion.angleTo(forward);
  const isBack = angle > Math.PI - MAX_ANGLE_RAD;
  const direction = angle < MAX_ANGLE_RAD ? "ahead" : isBack ? "behind" : "beside";
  return { by: isSurface ? "surface" : "unknown space", direction };
}

const PLACES: Record<Direction, string> = { ahead: "in front of you", behind: "behind you", beside: "beside you" };

/** One sentence for the user. */
export function blockText(block: Block): string {
  switch (block.by) {
    case "surface":
      return `A ${block.direction === "ahead" ? "surface" : "wall"} is ${PLACES[block.direction]}`;
    case "unknown space":
      return `The space ${PLACES[block.direction]} is hidden and not known yet`;
    case "near end":
      return "The view is at the point that it orbits: double-click on another point, or fly (Y)";
    case "far end":
      return "The zoom ends here: everything is in the picture";
    case "model before robot":
      return "The model hides the robot";
  }
}

/** Whether the cut removes it. */
export function canBeCut({ by }: Block): boolean {
  return by !== "near end" && by !== "far end";
}
