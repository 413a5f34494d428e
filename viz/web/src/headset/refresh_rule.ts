// When a new picture of the server is worth its time: the rules of "Radiance Fields for Robotic Teleoperation" (Wilder-Smith et
// al. 2024): after a motion of more than 0.1 m or 1 degree for a picture in the hand, and of more than 0.5 m for a sphere
// around the operator, which turning does not change. This file has no DOM.

import type { Matrix4 } from "three";
import { motionBetween } from "./eye_lens";

export interface RefreshLimits {
  meters: number;
  rad: number;
}

export const HANDHELD_LIMITS: RefreshLimits = { meters: 0.1, rad: Math.PI / 180 };
export const SPHERE_LIMITS: RefreshLimits = { meters: 0.5, rad: Infinity };
/** While the model trains, a picture of the same view is renewed after this time. */
const RENEW_MILLIS = 1000;

export class RefreshRule {
  private asked: { pose: Matrix4; atMillis: number } | null = null;

  constructor(private readonly limits: RefreshLimits) {}

  /** Whether a picture from this pose, in meters of the headset's space, should be requested now; if so, it counts as requested. */
  isDue(pose: Matrix4, nowMillis: number, isTraining: boolean): boolean {
    const { asked } = this;
    if (asked) {
      const { meters, rad } = motionBetween(asked.pose, pose);
      const hasMoved = meters > this.limits.meters || rad > this.limits.rad;
      const isOld = isTraining && nowMillis - asked.atMillis > RENEW_MILLIS;
      if (!hasMoved && !isOld) return false;
    }
    this.asked = { pose: pose.clone(), atMillis: nowMillis };
    return true;
  }

  /** Requests the next picture in any case. */
  forget(): void {
    this.asked = null;
  }
}
