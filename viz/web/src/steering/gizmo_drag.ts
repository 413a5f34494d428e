// Dragging a hand by one of the handles of its gizmo. The camera of the press is kept during the drag, because a view that
// moves with the robot would move the hand, too. This file has no DOM.

import { Plane, Quaternion, type Ray, Vector3 } from "three";
import type { Pose } from "./pose";

/** An arrow moves along an axis, a ring turns about it, and the ball in the middle moves parallel to the screen. */
export type Handle = { kind: "move" | "turn"; axis: 0 | 1 | 2 } | { kind: "plane" };

export const HANDLES: readonly Handle[] = [
  { kind: "plane" },
  ...([0, 1, 2] as const).map((axis) => ({ kind: "move", axis }) as const),
  ...([0, 1, 2] as const).map((axis) => ({ kind: "turn", axis }) as const),
];

/** Sizes relative to the gizmo: the arrows, and the rings. */
export const ARROW = { begin: 0.3, end: 1.15 };
export const RING_RADIUS = 0.78;
const RING_POINTS = 48;
/** If the ray is flatter to the plane of a ring than this cosine, the drag follows the tangent of the ring instead. */
const FLAT = 0.2;
/** Rays that are closer to an axis than this hit it too far away. */
const PARALLEL = 1e-3;

export interface ScreenPoint {
  x: number;
  y: number;
}

/** Points of a handle in axes of the gizmo, relative to its size. */
export function outline(handle: Handle): Vector3[] {
  if (handle.kind === "plane") return [new Vector3()];
  const axis = unit(handle.axis);
  if (handle.kind === "move") return [axis.clone().multiplyScalar(ARROW.begin), axis.clone().multiplyScalar(ARROW.end)];
  const [first, second] = [unit((handle.axis + 1) % 3), unit((handle.axis + 2) % 3)];
  return Array.from({ length: RING_POINTS + 1 }, (_, ix) => {
    const angle = (2 * Math.PI * ix) / RING_POINTS;
    return first.clone().multiplyScalar(RING_RADIUS * Math.cos(angle)).addScaledVector(second, RING_RADIUS * Math.sin(angle));
  });
}

/** Index of the nearest outline within a distance, pixels; -1 if there is none. Earlier ones win if several are equally close. */
export function nearestOutline(outlines: readonly (readonly ScreenPoint[])[], point: ScreenPoint, reachPx: number): number {
  const distances = outlines.map((points) => distanceToLine(points, point));
  const nearest = Math.min(...distances);
  return nearest <= reachPx ? distances.indexOf(nearest) : -1;
}

function distanceToLine(points: readonly ScreenPoint[], { x, y }: ScreenPoint): number {
  if (points.length === 1) return Math.hypot(points[0]!.x - x, points[0]!.y - y);
  const distances = points.slice(1).map((to, ix) => {
    const from = points[ix]!;
    const [dx, dy] = [to.x - from.x, to.y - from.y];
    const along = ((x - from.x) * dx + (y - from.y) * dy) / Math.max(dx * dx + dy * dy, 1e-9);
    const share = Math.min(1, Math.max(0, along));
    return Math.hypot(from.x + share * dx - x, from.y + share * dy - y);
  });
  return Math.min(Infinity, ...distances);
}

/** A drag from a press until the release, in one frame for all arguments. */
export class Drag {
  private readonly axis: Vector3;
  /** Where the ray of the press meets what the handle moves along. */
  private readonly from: Vector3 | null;
  /** Rotation so far, radians: a ring can be dragged around more than once. */
  private turned = 0;
  private readonly isFlat: boolean;

  /** `rotation` maps axes of the gizmo, `forward` is the direction of view. */
  constructor(
    private readonly handle: Handle,
    private readonly start: Pose,
    rotation: Quaternion,
    private readonly forward: Vector3,
    ray: Ray,
  ) {
    this.axis = handle.kind === "plane" ? forward.clone() : unit(handle.axis).applyQuaternion(rotation);
    this.isFlat = handle.kind === "turn" && Math.abs(ray.direction.dot(this.axis)) < FLAT;
    this.from = this.meet(ray);
  }

  /** The pose of the hand for a ray through the pointer. */
  to(ray: Ray): Pose {
    const { position, rotation } = this.start;
    const at = this.meet(ray);
    if (!at || !this.from) return { position: position.clone(), rotation: this.turnedRotation() };
    if (this.handle.kind !== "turn") {
      return { position: position.clone().add(at).sub(this.from), rotation: rotation.clone() };
    }
    this.turnTo(at, this.from);
    return { position: position.clone(), rotation: this.turnedRotation() };
  }

  private turnedRotation(): Quaternion {
    return new Quaternion().setFromAxisAngle(this.axis, this.turned).multiply(this.start.rotation);
  }

  private turnTo(at: Vector3, from: Vector3): void {
    const center = this.start.position;
    const arm = from.clone().sub(center);
    if (this.isFlat) {
      const tangent = this.axis.clone().cross(arm).normalize();
      this.turned = at.clone().sub(from).dot(tangent) / Math.max(arm.length(), 1e-6);
      return;
    }
    const now = at.clone().sub(center);
    const angle = Math.atan2(this.axis.dot(arm.clone().cross(now)), arm.dot(now));
    // The angle of two directions is known up to whole turns: the nearest one to the angle before is meant.
    this.turned = angle + 2 * Math.PI * Math.round((this.turned - angle) / (2 * Math.PI));
  }

  /** Where a ray meets the axis of an arrow, the plane of a ring, or the plane of the screen. */
  private meet(ray: Ray): Vector3 | null {
    const { position } = this.start;
    if (this.handle.kind === "move") {
      const along = closestAlong(position, this.axis, ray);
      return along === null ? null : position.clone().addScaledVector(this.axis, along);
    }
    const normal = this.handle.kind === "turn" && !this.isFlat ? this.axis : this.forward;
    const plane = new Plane().setFromNormalAndCoplanarPoint(normal, position);
    return ray.intersectPlane(plane, new Vector3());
  }
}

function unit(axis: number): Vector3 {
  return new Vector3().setComponent(axis, 1);
}

/** Position along a line, from its origin, of the point closest to a ray; null if they are parallel or meet behind the eye. */
function closestAlong(origin: Vector3, direction: Vector3, ray: Ray): number | null {
  const between = ray.origin.clone().sub(origin);
  const cosine = direction.dot(ray.direction);
  const denominator = 1 - cosine * cosine;
  if (denominator < PARALLEL) return null;
  const [onLine, onRay] = [direction.dot(between), ray.direction.dot(between)];
  const isBehind = cosine * onLine - onRay < 0;
  return isBehind ? null : (onLine - cosine * onRay) / denominator;
}
