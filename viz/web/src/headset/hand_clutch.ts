// The clutch between a hand and the tip of an arm: while it is closed, the tip makes the motions of the hand, beginning where
// it is. Everything that makes the hand's pose doubtful opens it until it is released and closed again. This file has no DOM.

import type { Quaternion, Vector3 } from "three";

export interface HandPose {
  position: Vector3;
  rotation: Quaternion;
}

/** The tip after the hand has moved from one pose to another one, all in the same frame. */
export function followed(tip: HandPose, handBefore: HandPose, handNow: HandPose): HandPose {
  const turn = handNow.rotation.clone().multiply(handBefore.rotation.clone().invert());
  return {
    position: tip.position.clone().add(handNow.position).sub(handBefore.position),
    rotation: turn.multiply(tip.rotation).normalize(),
  };
}

export interface ClutchEvents {
  /** Begins a motion. Returns where the tip is, or null if the arm does not follow. */
  begin(): HandPose | null;
  move(tip: HandPose): void;
  end(): void;
  /** Ends a motion for a reason other than the release. */
  interrupt(reason: string): void;
}

export class HandClutch {
  private held: { tip: HandPose; hand: HandPose } | null = null;
  private isDown = false;

  constructor(private readonly events: ClutchEvents) {}

  get isClosed(): boolean {
    return this.held !== null;
  }

  /** Follows a hand; null while it is not tracked. A hand that returns must be released before it can close the clutch. */
  update(hand: HandPose | null, isDown: boolean): void {
    if (!hand) {
      this.open("tracking of the hand was lost");
      return;
    }
    const isPress = isDown && !this.isDown;
    const isRelease = !isDown && this.isDown;
    this.isDown = isDown;
    if (isRelease) {
      if (this.held) this.events.end();
      this.held = null;
    } else if (isPress) {
      const tip = this.events.begin();
      this.held = tip && { tip, hand };
    } else if (this.held) {
      this.events.move(followed(this.held.tip, this.held.hand, hand));
    }
  }

  /** Takes note of a trigger that has another meaning now. */
  ignore(isDown: boolean): void {
    this.isDown = isDown;
  }

  /** Opens the clutch until it is released and closed again. */
  open(reason: string): void {
    if (!this.held) return;
    this.held = null;
    this.events.interrupt(reason);
    this.events.end();
  }
}
