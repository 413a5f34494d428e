// Hands that hold the scene: one moves it, two move, turn and scale it. This file has no DOM.

import type { Vector3 } from "three";
import { grabbed, grabbedByTwo, type Placement } from "./placement";

/** A hand that may hold the scene. */
export interface Holder {
  position: Vector3;
  isHolding: boolean;
}

export class SceneGrab {
  private before: { left: Vector3 | null; right: Vector3 | null } = { left: null, right: null };

  /** Whether a hand holds the scene. */
  get isHolding(): boolean {
    return this.before.left !== null || this.before.right !== null;
  }

  /** Follows the hands since the last call. A hand that has just taken the scene, or let go of it, moves nothing. */
  update(placement: Placement, left: Holder | null, right: Holder | null): Placement {
    const held = {
      left: left?.isHolding ? left.position.clone() : null,
      right: right?.isHolding ? right.position.clone() : null,
    };
    const { before } = this;
    this.before = held;
    const isSame = (before.left === null) === (held.left === null) && (before.right === null) === (held.right === null);
    if (!isSame) return placement;
    if (before.left && before.right && held.left && held.right) {
      return grabbedByTwo(placement, [before.left, before.right], [held.left, held.right]);
    }
    if (before.left && held.left) return grabbed(placement, before.left, held.left);
    if (before.right && held.right) return grabbed(placement, before.right, held.right);
    return placement;
  }

  /** Lets go of the scene. */
  release(): void {
    this.before = { left: null, right: null };
  }
}
