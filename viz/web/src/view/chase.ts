// Moves the view with a frame of the robot: with its position and its yaw, but not with its pitch and roll.

import { type Matrix4, Quaternion, Vector3 } from "three";
import type { Viewpoint } from "./eye_guard";
import { Follower, type Pose } from "./follower";

/**
 * Motions within these limits are not followed, so that the view rests and its pictures become
 * sharp. The base or a slow link of an arm that scans often stays within them.
 */
const DEAD_BAND_M = 0.02;
const DEAD_BAND_RAD = (4 * Math.PI) / 180;
const DAMPING_SECS = 0.25;

/**
 * Distance of the first view of a robot that was not in the picture, relative to its size. The
 * robot is seen from behind.
 */
const BEHIND_SIZES = 2.2;
const MIN_BEHIND_M = 0.8;
const DOWN_RAD = (25 * Math.PI) / 180;

export class Chase {
  private readonly follower = new Follower({
    deadBandM: DEAD_BAND_M,
    deadBandRad: DEAD_BAND_RAD,
    dampingSecs: DAMPING_SECS,
  });

  /** Starts again. From the next update on, the view keeps its pose relative to the frame. */
  restart(): void {
    this.follower.forget();
  }

  /** Moves a view with a frame; null if it rests. */
  update(view: Viewpoint, worldFromFrame: Matrix4, secs: number): Viewpoint | null {
    const goal = poseOf(worldFromFrame);
    const before = this.follower.pose;
    if (!before) {
      this.follower.update(goal, secs);
      return null;
    }
    const from = { position: before.position.clone(), rotation: before.rotation.clone() };
    if (!this.follower.update(goal, secs)) return null;
    const { position, rotation } = this.follower.pose!;
    const turn = new Quaternion().setFromAxisAngle(UP, yawBetween(from.rotation, rotation));
    const move = (point: Vector3): Vector3 => point.clone().sub(from.position).applyQuaternion(turn).add(position);
    return { eye: move(view.eye), target: move(view.target) };
  }
}

const UP = new Vector3(0, 0, 1);

/** The angle about z of the rotation from one pose to another (the twist of its swing-twist decomposition). */
export function yawBetween(from: Quaternion, to: Quaternion): number {
  const { z, w } = to.clone().multiply(from.clone().invert());
  const yaw = 2 * Math.atan2(z, w);
  // A quaternion and its negative are the same rotation.
  return yaw > Math.PI ? yaw - 2 * Math.PI : yaw < -Math.PI ? yaw + 2 * Math.PI : yaw;
}

/** A view from behind a robot of this size, above its back. */
export function viewFromBehind(center: Vector3, sizeM: number, headingRad: number): Viewpoint {
  const distanceM = Math.max(MIN_BEHIND_M, BEHIND_SIZES * sizeM);
  const back = new Vector3(-Math.cos(headingRad), -Math.sin(headingRad), Math.tan(DOWN_RAD)).normalize();
  return { eye: center.clone().addScaledVector(back, distanceM), target: center.clone() };
}

function poseOf(matrix: Matrix4): Pose {
  const pose = { position: new Vector3(), rotation: new Quaternion() };
  matrix.decompose(pose.position, pose.rotation, new Vector3());
  return pose;
}
