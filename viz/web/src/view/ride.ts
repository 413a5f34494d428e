// Attaches the view to a camera of the robot. The view follows the pose of the camera, including
// its roll, and has its lens.

import { Quaternion, Vector3 } from "three";
import type { PosedCamera } from "../connection/protocol";
import { worldFromThreeCamera } from "./convention";
import { Follower } from "./follower";
import type { Viewpoint } from "./eye_guard";

/** Smaller motions of a camera are errors of its pose. */
const DEAD_BAND_M = 0.002;
const DEAD_BAND_RAD = (0.2 * Math.PI) / 180;
/** Time constant of the motion. Poses arrive several times per second, and the view moves smoothly between them. */
const DAMPING_SECS = 0.12;

export class Ride {
  private readonly follower = new Follower({
    deadBandM: DEAD_BAND_M,
    deadBandRad: DEAD_BAND_RAD,
    dampingSecs: DAMPING_SECS,
  });

  /** Starts at the camera's next pose, for example because it is another camera. */
  restart(): void {
    this.follower.forget();
  }

  /**
   * Moves the view with the camera; null if the view rests. `distanceAhead` is the distance to the
   * target of the view.
   */
  update(
    camera: PosedCamera,
    distanceAhead: (eye: Vector3, forward: Vector3) => number,
    secs: number,
  ): (Viewpoint & { rotation: Quaternion }) | null {
    const goal = { position: new Vector3(), rotation: new Quaternion() };
    worldFromThreeCamera(camera.world_from_camera).decompose(goal.position, goal.rotation, new Vector3());
    if (!this.follower.update(goal, secs)) return null;
    const { position, rotation } = this.follower.pose!;
    const forward = new Vector3(0, 0, -1).applyQuaternion(rotation);
    const target = position.clone().addScaledVector(forward, distanceAhead(position, forward));
    return { eye: position.clone(), target, rotation };
  }
}

/** The vertical field of view with which the whole image of a camera fits into a view of this aspect ratio. */
export function lensDegrees({ size_px, focal_px, principal_px }: PosedCamera, aspect: number): number {
  // The view is symmetric, but the principal point of a camera is not exactly in the middle of its
  // image.
  const [across, along] = ([0, 1] as const).map(
    (axis) => Math.max(principal_px[axis], size_px[axis] - principal_px[axis]) / focal_px[axis],
  ) as [number, number];
  return (2 * Math.atan(Math.max(along, across / aspect)) * 180) / Math.PI;
}

/** The camera after the present one; the first one if none is present. */
export function nextCamera(cameras: string[], current: string | null): string | null {
  const next = current === null ? 0 : (cameras.indexOf(current) + 1) % cameras.length;
  return cameras[next] ?? null;
}
