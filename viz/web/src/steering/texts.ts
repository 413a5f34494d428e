// What the panel says about control, the link, limits and goals. This file has no DOM.

import type { Avoidance, Limit, SteerState, Verdict } from "./messages";
import type { Mode } from "./round_trip";

/** Who has control, from the view of one client. `robot` names the steered part of the robot. */
export function leaseText({ holder, lease_left_secs, offered_to, moved_part }: SteerState, client: number, robot = "arm"): string {
  if (holder === null) return `Nobody has control of the ${robot}`;
  if (holder === client) {
    return offered_to === null ? "You have control" : `You have control, offered to operator ${offered_to}`;
  }
  // The time begins anew with each message of the holder.
  const left = lease_left_secs === null ? "" : ` for at least ${Math.max(0, lease_left_secs).toFixed(0)} s more`;
  const what = moved_part === null ? "" : ` and moves the ${moved_part}`;
  const who = `Operator ${holder} has control${what}${left}`;
  return offered_to === client ? `${who}. Control is offered to you` : who;
}

/** The steered parts of a robot in one word. */
export function robotName(hasArm: boolean, hasBase: boolean): string {
  if (hasArm && hasBase) return "robot";
  return hasBase ? "base" : "arm";
}

/** What keeps a base away from obstacles, in one sentence. */
export function avoidanceText(avoidance: Avoidance): string {
  switch (avoidance) {
    case "unknown_space":
      return "The base stops before everything that is not known to be free";
    case "seen_surfaces":
      return "The base stops before surfaces that were seen. It enters space that nothing has seen: look where it drives";
    case "nothing":
      return "Nothing but you keeps the base away from obstacles";
  }
}

/** Why the arm is stopped, and that it is being recovered; empty if neither is so. */
export function stopText({ stop, is_recovering, base, position }: SteerState): string {
  const reason = stop === null ? "" : `The ${robotName(position.length > 0, base !== null)} is stopped: ${stop}`;
  if (!is_recovering) return reason;
  return `The arm is being recovered. Motion is permitted afterward, unless somebody stops it. ${reason}`.trimEnd();
}

/** How the arm is moved now, and why. */
export function modeText(mode: Mode, roundTripMillis: number | null, thresholdMillis: number, isForced: boolean): string {
  const limit = `limit ${Math.round(thresholdMillis)} ms`;
  const measured = roundTripMillis === null ? `link not measured yet, ${limit}` : `${Math.round(roundTripMillis)} ms, ${limit}`;
  if (mode === "servo") return `Servo: the arm follows while you hold (${measured})`;
  return `Preview, then go${isForced ? " as chosen" : ""}: you move the ghost, then hold Go (${measured})`;
}

/** How a base is driven, and whether it may be sent to a goal. */
export function baseText(roundTripMillis: number | null): string {
  const measured = roundTripMillis === null ? "link not measured yet" : `${Math.round(roundTripMillis)} ms`;
  return `The base moves while you hold (${measured})`;
}

/** State of a goal of a base, and what the operator must do. */
export function baseGoalText(hasArrived: boolean, mayGo: boolean): string {
  if (!mayGo) return "The goal is outside the area of the base";
  return hasArrived ? "The base is at the goal" : "Hold Go until the base is there";
}

/** A limit in one sentence. */
export function limitText({ effect, speed_scale, text }: Limit): string {
  if (effect === "slowed") return `Slowed to ${Math.round(100 * speed_scale)} %: ${text}`;
  return `${effect === "refused" ? "Refused" : "Braking"}: ${text}`;
}

/** The limits that say something: an open switch is the normal state of a clutch. */
export function shownLimits(limits: readonly Limit[], isHeld: boolean): Limit[] {
  const isNews = ({ link, effect }: Limit): boolean => isHeld || effect === "slowed" || (link !== "clutch" && link !== "lease");
  return limits.filter(isNews);
}

const VERDICT_TEXTS: Record<Verdict, string> = {
  reachable: "The goal can be reached",
  near: "The goal is close to a surface, where the arm slows down or stops",
  unreachable: "The goal is out of reach",
  "self-collision": "The robot would touch itself",
  "never seen": "No camera has seen the space at the goal",
  limits: "The goal is beyond a limit",
};

/** A verdict in one sentence, with the reason of the server. */
export function verdictText(verdict: Verdict, text: string): string {
  return text === "" ? VERDICT_TEXTS[verdict] : `${VERDICT_TEXTS[verdict]}: ${text}`;
}

/** A joint position in the units of operators. */
export function jointText(position: number, isPrismatic: boolean): string {
  return isPrismatic ? `${(1000 * position).toFixed(1)} mm` : `${((180 / Math.PI) * position).toFixed(1)}°`;
}
