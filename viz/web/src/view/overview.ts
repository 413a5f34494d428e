// Views of everything, in which the bounds of the scene, the robot and its path fill the picture.

import { Box3, type Matrix4, Vector3 } from "three";
import type { Scene } from "../connection/protocol";
import { worldFromCamera } from "./convention";
import type { Viewpoint } from "./eye_guard";
import { uprightRotation } from "./up_axis";

/** The overview looks down by this angle, and past the right side of the robot, which would hide the scene. */
const DOWN_RAD = (35 * Math.PI) / 180;
const LEFT_RAD = (25 * Math.PI) / 180;
/** Fraction of the picture that is filled. The rest is for toolbars and camera images. */
const FILLED_FRAC = 0.86;
/** Half the side of the bounds relative to the radius of the scene, if only the radius is known. */
const SIDE_PER_RADIUS = 0.75;
/** The overview is adapted when something lies outside of it by more than this fraction of its diagonal. */
const SLACK_FRAC = 0.05;
const MIN_DISTANCE_M = 0.05;
/** A camera that looks down more steeply than this has the heading of the upper edge of its image. */
const MIN_HORIZONTAL = 0.3;

/** Vertical field of view, width by height, and the direction that points up in the picture. */
export interface Lens {
  fovDegrees: number;
  aspect: number;
  up: Vector3;
}

/** The relevant parts of a scene. */
export function boundsOf(scene: Scene): Box3 {
  if (scene.bounds) return new Box3(new Vector3(...scene.bounds.min_m), new Vector3(...scene.bounds.max_m));
  const side = new Vector3().setScalar(2 * SIDE_PER_RADIUS * scene.radius_m);
  return new Box3().setFromCenterAndSize(new Vector3(...scene.center_m), side);
}

/** Heading of a robot, whose x axis points to its front: angle about z, from x of the world. */
export function headingOfBase(worldFromBase: Matrix4): number {
  const front = new Vector3().setFromMatrixColumn(worldFromBase, 0);
  return Math.atan2(front.y, front.x);
}

/**
 * Heading of a camera. This is its viewing direction or, if this direction is almost vertical, the
 * direction of the upper edge of its image.
 */
export function headingOfCamera(rowMajor: number[]): number {
  const pose = worldFromCamera(rowMajor);
  const forward = new Vector3().setFromMatrixColumn(pose, 2);
  const down = new Vector3().setFromMatrixColumn(pose, 1);
  const { x, y } = Math.hypot(forward.x, forward.y) > MIN_HORIZONTAL ? forward : down.multiplyScalar(Math.sign(forward.z));
  return Math.atan2(y, x);
}

/** The direction of an overview from behind a robot or a camera with this heading. */
export function overviewDirection(headingRad: number, isRobot: boolean): Vector3 {
  const yaw = isRobot ? headingRad + LEFT_RAD : headingRad;
  return new Vector3(Math.cos(DOWN_RAD) * Math.cos(yaw), Math.cos(DOWN_RAD) * Math.sin(yaw), -Math.sin(DOWN_RAD));
}

/** The direction of a view from above. Exactly from above, the direction of "up" would be undefined. */
export function topDirection(): Vector3 {
  return new Vector3(0, 1e-3, -1).normalize();
}

/** The direction of a view of the front of the robot. Without a robot, it is along y, as is usual for z-up models. */
export function frontDirection(robotHeadingRad: number | null): Vector3 {
  if (robotHeadingRad === null) return new Vector3(0, 1, 0);
  return new Vector3(-Math.cos(robotHeadingRad), -Math.sin(robotHeadingRad), 0);
}

/**
 * The closest viewpoint from which all points are in the picture. The direction is given for a
 * world that is z up. If another direction points up, the given direction is rotated accordingly.
 * The target is in the middle of the points.
 */
export function viewOf(points: Vector3[], direction: Vector3, { fovDegrees, aspect, up: upInWorld }: Lens): Viewpoint {
  const forward = direction.clone().normalize().applyQuaternion(uprightRotation(upInWorld));
  const right = forward.clone().cross(upInWorld).normalize();
  const up = right.clone().cross(forward);
  const tangent = Math.tan((fovDegrees * Math.PI) / 360) * FILLED_FRAC;
  const depths = points.map((point) => point.dot(forward));
  const across = fit(points.map((point) => point.dot(right)), depths, tangent * aspect);
  const along = fit(points.map((point) => point.dot(up)), depths, tangent);
  const middle = 0.5 * (Math.min(...depths) + Math.max(...depths));
  const depth = Math.min(across.depth, along.depth, Math.min(...depths) - MIN_DISTANCE_M);
  const eye = right.multiplyScalar(across.middle).addScaledVector(up, along.middle).addScaledVector(forward, depth);
  return { eye, target: eye.clone().addScaledVector(forward, middle - depth) };
}

/**
 * The greatest depth of an eye from which points appear within a tangent of the line of sight, and its place across.
 * A point at `x` and `z` is within it if `|x - eyeX| <= (z - eyeZ) * tangent`.
 */
function fit(places: number[], depths: number[], tangent: number): { depth: number; middle: number } {
  const low = Math.max(...places.map((place, ix) => place - depths[ix]! * tangent));
  const high = Math.min(...places.map((place, ix) => place + depths[ix]! * tangent));
  return { depth: (high - low) / (2 * tangent), middle: 0.5 * (low + high) };
}

/** The corners of boxes. Empty boxes have no corners. */
export function cornersOf(boxes: Box3[]): Vector3[] {
  return boxes
    .filter((box) => !box.isEmpty())
    .flatMap(({ min, max }) =>
      [min.x, max.x].flatMap((x) => [min.y, max.y].flatMap((y) => [min.z, max.z].map((z) => new Vector3(x, y, z)))),
    );
}

/** Whether the content has grown beyond the part that the overview shows. */
export function outgrows(content: Box3, shown: Box3): boolean {
  if (content.isEmpty()) return false;
  if (shown.isEmpty()) return true;
  const slackM = SLACK_FRAC * shown.getSize(new Vector3()).length();
  return !shown.clone().expandByScalar(slackM).containsBox(content);
}
