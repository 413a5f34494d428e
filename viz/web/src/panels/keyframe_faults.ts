// Describes the faults of a keyframe in words.

import type { KeyframeErrors } from "./keyframe_error";
import { durationText } from "./quantities";

/** What is known about a keyframe besides its pixels. */
export interface KeyframeFacts {
  /** Correction of its pose that the model has estimated; null if it is not known. */
  correction: PoseDifference | null;
  /** Time since it was taken; null if it is not known. */
  ageSecs: number | null;
  /** Rotation of the camera at mid-exposure; null if it is not known. */
  turnRadS: number | null;
}

export interface PoseDifference {
  meters: number;
  radians: number;
}

/** A photograph with less of the model's detail is less sharp than the photographs around it. */
const BLURRED_RATIO = 0.6;
/** A model with less than half of the photograph's detail has not learned it yet, or too few keyframes show it. */
const SMOOTH_RATIO = 2;
/** Rotations above this, 30 degrees per second, are a likely cause of blur. */
const FAST_TURN_RAD_S = 0.5;
/** Minimum exposure difference that is visible side by side. */
const MIN_EXPOSURE_EV = 0.2;
/** Corrections that are larger than the noise of a good calibration. */
const MIN_CORRECTION = { meters: 0.002, radians: 0.0035 };
const OLD_SECS = 120;
/** A part of the photograph that the model cannot explain. */
const MIN_EMPTY_FRAC = 0.05;
/** Without another cause, a picture with less PSNR is still wrong. */
const MIN_PSNR = 20;

/** One sentence part for each fault, the most important first. */
export function keyframeFaults(errors: KeyframeErrors | null, facts: KeyframeFacts): string[] {
  const found = [...(errors ? pixelFaults(errors, facts) : []), ...poseFaults(facts)];
  if (found.length === 0 && errors && errors.psnr < MIN_PSNR) {
    found.push(`large error everywhere (${errors.psnr.toFixed(1)} dB): the model may not have converged yet`);
  }
  return found;
}

function pixelFaults(errors: KeyframeErrors, { turnRadS }: KeyframeFacts): string[] {
  const { worst, shiftPx, detailRatio, exposureEv, emptyFrac } = errors;
  const faults: string[] = [];
  const isBlurred = detailRatio !== null && detailRatio < BLURRED_RATIO;
  if (shiftPx) faults.push(`shifted by ${shiftText(shiftPx)}: the pose or the time offset may be wrong`);
  // Blur changes the picture most where the scene has the most detail. The error is then no sign of motion.
  if (worst) faults.push(`large error in the ${worst.name}${isBlurred ? "" : ": did something move there?"}`);
  if (isBlurred) {
    const isFast = turnRadS !== null && turnRadS > FAST_TURN_RAD_S;
    faults.push(`blurred${isFast ? `: the camera turned by ${degrees(turnRadS).toFixed(0)} degrees per second` : ""}`);
  }
  if (detailRatio !== null && detailRatio > SMOOTH_RATIO) {
    faults.push("the model lacks detail here: more keyframes from nearby would help");
  }
  if (exposureEv !== null && Math.abs(exposureEv) >= MIN_EXPOSURE_EV) {
    const direction = exposureEv > 0 ? "brighter" : "darker";
    faults.push(`exposure differs by ${Math.abs(exposureEv).toFixed(1)} EV: the photograph is ${direction}`);
  }
  if (emptyFrac !== null && emptyFrac >= MIN_EMPTY_FRAC) {
    faults.push(`the model is empty in ${(100 * emptyFrac).toFixed(0)} % of the picture`);
  }
  return faults;
}

function poseFaults({ correction, ageSecs }: KeyframeFacts): string[] {
  const faults: string[] = [];
  if (correction && (correction.meters >= MIN_CORRECTION.meters || correction.radians >= MIN_CORRECTION.radians)) {
    faults.push(`pose corrected by ${correctionText(correction)}`);
  }
  if (ageSecs !== null && ageSecs >= OLD_SECS) faults.push(`old: ${durationText(ageSecs)}`);
  return faults;
}

/** Difference of two poses, as 16 numbers each, row major. */
export function poseDifference(one: number[], other: number[]): PoseDifference {
  const meters = Math.hypot(...[3, 7, 11].map((ix) => one[ix]! - other[ix]!));
  // The trace of the relative rotation is the sum of the products of all elements.
  const trace = [0, 1, 2, 4, 5, 6, 8, 9, 10].reduce((sum, ix) => sum + one[ix]! * other[ix]!, 0);
  return { meters, radians: Math.acos(Math.min(1, Math.max(-1, 0.5 * (trace - 1)))) };
}

export function correctionText({ meters, radians }: PoseDifference): string {
  return `${(1000 * meters).toFixed(1)} mm and ${degrees(radians).toFixed(2)} degrees`;
}

/** The shift as text, such as "4 px to the right and 2 px up". */
function shiftText([dx, dy]: [number, number]): string {
  const part = (px: number, [negative, positive]: [string, string]): string[] =>
    Math.abs(px) < 0.5 ? [] : [`${Math.abs(px).toFixed(Math.abs(px) < 10 ? 1 : 0)} px ${px < 0 ? negative : positive}`];
  const parts = [...part(dx, ["to the left", "to the right"]), ...part(dy, ["up", "down"])];
  return parts.length > 0 ? parts.join(" and ") : `${Math.hypot(dx, dy).toFixed(1)} px`;
}

function degrees(radians: number): number {
  return (radians * 180) / Math.PI;
}
