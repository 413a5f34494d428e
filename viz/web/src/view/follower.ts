// Follows a moving pose smoothly, and rests while the pose hardly moves.

import type { Quaternion, Vector3 } from "three";

export interface FollowerOptions {
  /** Motions within these limits are not followed, so that the picture can become sharp meanwhile. */
  deadBandM: number;
  deadBandRad: number;
  /** The distance to the pose decays with this time constant. */
  dampingSecs: number;
}

/**
 * The motion ends when the pose is closer than this fraction of the dead band, because a noisy pose
 * is never reached exactly.
 */
const REACHED_FRAC = 0.04;

export interface Pose {
  position: Vector3;
  rotation: Quaternion;
}

export class Follower {
  /** The present pose; null before the first pose. */
  pose: Pose | null = null;
  private isMoving = false;

  constructor(private readonly options: FollowerOptions) {}

  /** Starts at the next pose. */
  forget(): void {
    this.pose = null;
    this.isMoving = false;
  }

  /** Moves toward a pose for some time; returns whether it has moved. */
  update(goal: Pose, secs: number): boolean {
    if (!this.pose) {
      this.pose = { position: goal.position.clone(), rotation: goal.rotation.clone() };
      return true;
    }
    const { position, rotation } = this.pose;
    const distanceM = position.distanceTo(goal.position);
    const angleRad = rotation.angleTo(goal.rotation);
    const { deadBandM, deadBandRad, dampingSecs } = this.options;
    this.isMoving ||= distanceM > deadBandM || angleRad > deadBandRad;
    if (!this.isMoving) return false;
    if (distanceM < REACHED_FRAC * deadBandM && angleRad < REACHED_FRAC * deadBandRad) {
      this.isMoving = false;
      position.copy(goal.position);
      rotation.copy(goal.rotation);
      return distanceM > 0 || angleRad > 0;
    }
    const share = 1 - Math.exp(-secs / dampingSecs);
    position.lerp(goal.position, share);
    rotation.slerp(goal.rotation, share);
    return true;
  }
}
