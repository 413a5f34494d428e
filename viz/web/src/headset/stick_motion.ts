// What the sticks of the controllers do: glide, turn in steps, and jump to a place on the floor. This file has no DOM.

import { Vector3 } from "three";
import { headYawRad, moved, type Placement, turned } from "./placement";
import type { Matrix4 } from "three";

/** Speed of gliding at the full deflection, meters of the headset's space per second. */
const SPEED_M_S = 1.4;
/** Smaller deflections have no effect. */
const DEAD_ZONE = 0.2;
/** A step of a turn, and the deflections at which it is taken and at which the next one becomes possible. */
const TURN_RAD = Math.PI / 6;
const TURN_AT = 0.7;
const READY_AT = 0.4;
/** The jump is aimed at while the stick is forward beyond the first deflection, and takes place below the second one. */
const AIM_AT = 0.7;
const MAX_STEP_SECS = 0.1;

export interface StickResult {
  placement: Placement;
  /** Whether the operator is gliding, which makes some people sick. */
  isMoving: boolean;
  /** Whether the place of a jump is being chosen. */
  isAiming: boolean;
  /** Whether the operator jumps now. */
  jumps: boolean;
}

export class StickMotion {
  private mayTurn = true;
  private wasAiming = false;

  /** Applies the sticks of the hand that glides and of the hand that turns and jumps. */
  update(
    placement: Placement,
    glide: readonly [number, number],
    turn: readonly [number, number],
    headsetFromHead: Matrix4,
    secs: number,
  ): StickResult {
    const head = new Vector3().setFromMatrixPosition(headsetFromHead);
    const [right, forward] = [beyondDeadZone(glide[0]), beyondDeadZone(glide[1])];
    const isMoving = right !== 0 || forward !== 0;
    let next = placement;
    if (isMoving) {
      const meters = SPEED_M_S * Math.min(secs, MAX_STEP_SECS);
      const ahead = new Vector3(right, 0, -forward).applyAxisAngle(new Vector3(0, 1, 0), headYawRad(headsetFromHead));
      next = moved(next, ahead.multiplyScalar(meters));
    }
    if (Math.abs(turn[0]) < READY_AT) this.mayTurn = true;
    const isAiming = turn[1] > AIM_AT || (this.wasAiming && turn[1] > READY_AT);
    if (this.mayTurn && !isAiming && Math.abs(turn[0]) > TURN_AT) {
      this.mayTurn = false;
      next = turned(next, -Math.sign(turn[0]) * TURN_RAD, head);
    }
    const jumps = this.wasAiming && !isAiming;
    this.wasAiming = isAiming;
    return { placement: next, isMoving, isAiming, jumps };
  }
}

function beyondDeadZone(value: number): number {
  return Math.abs(value) < DEAD_ZONE ? 0 : value;
}
