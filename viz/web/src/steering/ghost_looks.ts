// Which look the ghost has. Each look has a distinct pattern besides its color, because some people cannot distinguish the
// colors. This file has no DOM.

import type { Limit, Verdict } from "./messages";

export type GhostLookName = "reachable" | "near" | "collision" | "unreachable" | "checking";

export const LOOKS: Record<GhostLookName, { color: number; pattern: number; name: string }> = {
  reachable: { color: 0x4cc2a6, pattern: 0, name: "even grid: reachable" },
  near: { color: 0xe3b341, pattern: 1, name: "stripes: close to a surface" },
  collision: { color: 0xf0716a, pattern: 2, name: "crossed bars: collision" },
  unreachable: { color: 0xc9d2dc, pattern: 3, name: "dots: out of reach" },
  checking: { color: 0x97a3b3, pattern: 4, name: "lines: being checked" },
};

const OF_VERDICT: Record<Verdict, GhostLookName> = {
  reachable: "reachable",
  near: "near",
  unreachable: "unreachable",
  "self-collision": "collision",
  "never seen": "collision", // Unknown space counts as occupied.
  limits: "unreachable",
};

export function lookOfVerdict(verdict: Verdict): GhostLookName {
  return OF_VERDICT[verdict];
}

/** The look of the target that the arm follows, by the limits on its way. */
export function lookOfLimits(limits: readonly Limit[]): GhostLookName {
  const blocks = limits.filter(({ effect }) => effect !== "slowed");
  if (blocks.some(({ link }) => link === "self-collision" || link === "clearance")) return "collision";
  if (blocks.some(({ link }) => link === "limits")) return "unreachable";
  return limits.some(({ link }) => link === "clearance" || link === "self-collision") ? "near" : "reachable";
}

/** Whether two lists of joint positions differ so much that a ghost beside the robot is visible, radians or meters. */
export function isApart(a: readonly number[], b: readonly number[]): boolean {
  const VISIBLE = 0.01;
  return a.some((value, ix) => Math.abs(value - (b[ix] ?? value)) > VISIBLE);
}
