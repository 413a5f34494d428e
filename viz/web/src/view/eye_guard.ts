// Keeps the eye in front of the surfaces of the model.
//
// A motion ends before a surface that is known from a picture or from the mesh. A surface that was
// not known during the motion may appear in a later picture, between the new and the earlier
// positions of the eye. The eye then returns. Space behind a surface is unknown. If the
// surroundings of the eye are known, the eye stops at the edge of unknown space until newer
// surroundings arrive.

import { Vector3 } from "three";
import type { DepthMap } from "../layers/depth_map";

/** Distance to surfaces relative to the near plane, whose corners are farther away than its center. */
const MARGIN_NEARS = 3;
/** Length of the steps along a motion, in margins. */
const STEP_MARGINS = 0.25;
const MAX_STEPS = 800;
/**
 * If a step leads to a greater depth behind a surface than this, in margins, the eye has passed the
 * edge of the surface and not the surface itself.
 */
const MAX_DEPTH_MARGINS = 4;
/**
 * The eye is inside an object if most visible surfaces are closer than this, in margins. Surfaces
 * at a corner of a room are not as close.
 */
const INSIDE_MARGINS = 0.7;
const MAX_TRAIL = 2000;

/** Points around the eye, in margins, that must stay in front of surfaces. */
const BALL = [0, 1, 2].flatMap((axis) => [-1, 1].map((sign) => new Vector3().setComponent(axis, sign)));

/** An eye, and the point it looked at. */
export interface Viewpoint {
  eye: Vector3;
  target: Vector3;
}

/** The first surface of the mesh on a path: distance along the path and normal, or null. */
export type HitMesh = (from: Vector3, direction: Vector3, maxM: number) => { distance: number; normal: Vector3 } | null;

export class EyeGuard {
  /** Distance of the near plane, meters. */
  nearM = 0.01;
  private readonly maps = new Map<string, DepthMap>();
  /**
   * The positions of the eye since the last position that is known to be good. The first entry is
   * this good position, if there is one.
   */
  private trail: Viewpoint[] = [];
  private hasGood = false;
  /** Whether maps of all directions arrive. Other maps do not show whether the eye has passed a surface beside it. */
  private hasComplete = false;
  /** Whether the last motion that was limited ended at a surface, and not at the edge of unknown space. */
  isStoppedBySurface = false;

  constructor(private readonly hitMesh: HitMesh) {}

  private get marginM(): number {
    return MARGIN_NEARS * this.nearM;
  }

  /** Starts at a new position after a jump. `isGood` is set if the position is known to be in front of all surfaces. */
  jump(viewpoint: Viewpoint, isGood: boolean): void {
    this.trail = [copy(viewpoint)];
    this.hasGood = isGood;
    if (!isGood) this.maps.clear(); // They show other surroundings.
  }

  /** Forgets what is known about the model. */
  forget(): void {
    this.maps.clear();
    this.hasComplete = false;
  }

  /** Forgets the maps of all directions, because newer ones will not arrive. */
  forgetComplete(): void {
    for (const [name, map] of this.maps) if (map.isComplete) this.maps.delete(name);
    this.hasComplete = false;
  }

  /** Radius around the eye without surfaces, meters; negative if it is not known. */
  freeRadiusM(eye: Vector3): number {
    const radii = [...this.maps.values()].map((map) => map.nearestM - map.origin.distanceTo(eye));
    return Math.max(-Infinity, ...radii);
  }

  /**
   * The last allowed position of the eye on the path to another position. If `slides` is set, the
   * motion continues along a surface.
   */
  limit(to: Vector3, slides: boolean): Vector3 {
    const from = this.trail.at(-1)?.eye;
    if (!from || from.equals(to)) return to;
    const first = this.march(from, to);
    this.isStoppedBySurface = first.isSurface;
    if (!first.normal || !slides) return first.eye;
    const rest = to.clone().sub(first.eye);
    const into = Math.min(0, rest.dot(first.normal));
    return this.march(first.eye, rest.addScaledVector(first.normal, -into).add(first.eye)).eye;
  }

  /** Records where the eye is. */
  moved(viewpoint: Viewpoint): void {
    this.trail.push(copy(viewpoint));
    // Beyond this length, the oldest positions are removed. The eye then returns to the oldest
    // position that remains.
    if (this.trail.length > MAX_TRAIL) this.trail.splice(0, MAX_TRAIL / 2);
  }

  /** Adopts a newer map. Returns the place to return to if it shows that the eye has passed a surface. */
  see(name: string, map: DepthMap): Viewpoint | null {
    this.maps.set(name, map);
    const distances = this.trail.map(({ eye }) => eye.distanceToSquared(map.origin));
    const seenFrom = distances.lastIndexOf(Math.min(...distances));
    const isInside = map.isWithin(INSIDE_MARGINS * this.marginM);
    if (isInside) this.maps.delete(name); // Otherwise, no motion would be possible.
    if (seenFrom < 0) return null;
    const back = this.trail.slice(0, seenFrom + 1).reverse();
    const isBad = isInside || this.isCrossed(map, back);
    if (isBad && this.hasGood) return this.trail[0]!;
    if (isInside) return null;
    this.hasComplete ||= map.isComplete;
    if (map.isComplete || !this.hasComplete) {
      this.trail.splice(0, seenFrom);
      this.hasGood = true;
    }
    return null;
  }

  /** Moves until a surface is too close. Motions away from surfaces are always possible. */
  private march(from: Vector3, to: Vector3): { eye: Vector3; normal: Vector3 | null; isSurface: boolean } {
    const margin = this.marginM;
    const motion = to.clone().sub(from);
    const length = motion.length();
    const direction = motion.clone().normalize();
    const hit = this.hitMesh(from, direction, length + margin);
    const n = Math.min(MAX_STEPS, Math.ceil(length / (STEP_MARGINS * margin)));
    const maps = [...this.maps.values()].map((map) => ({ map, minM: Math.min(0, this.clearanceOfBall(map, from)) }));
    const complete = [...this.maps.values()].find((map) => map.isComplete);
    const wasKnown = this.isKnown(from);
    let eye = from.clone();
    for (let step = 1; step <= n; step++) {
      const next = from.clone().addScaledVector(motion, step / n);
      if (hit && (length * step) / n > hit.distance - margin) return { eye, normal: hit.normal, isSurface: true };
      // From unknown space, the eye can move back toward the point from which the surroundings were
      // seen.
      const isBack = !wasKnown && complete && next.distanceTo(complete.origin) < eye.distanceTo(complete.origin);
      if (complete && !isBack && !this.isKnown(next)) return { eye, normal: null, isSurface: false };
      for (const { map, minM } of maps) {
        if (this.clearanceOfBall(map, next) < minM) return { eye, normal: this.normal(map, eye), isSurface: true };
      }
      eye = next;
    }
    return { eye: n > 0 ? to : from, normal: null, isSurface: false };
  }

  /** Whether a point is visible from the origin of a map in all directions, or in front of a surface in a picture. */
  private isKnown(point: Vector3): boolean {
    return [...this.maps.values()].some((map) => {
      // A surface that was seen from far away at a small angle is known only coarsely.
      const clearance = map.smallestClearance(point);
      return clearance > 0 && (map.isComplete || clearance < Infinity);
    });
  }

  /** Minimum clearance of the points around the eye. Hidden points are left out. */
  private clearanceOfBall(map: DepthMap, eye: Vector3): number {
    const clearances = BALL.map((point) => map.clearance(point.clone().multiplyScalar(this.marginM).add(eye)));
    return Math.min(...clearances.filter((clearance) => clearance > -MAX_DEPTH_MARGINS * this.marginM));
  }

  /** Direction in which the clearance grows most; null if there is none. */
  private normal(map: DepthMap, at: Vector3): Vector3 | null {
    const gradient = [0, 1, 2].map((axis) => {
      const nudge = new Vector3().setComponent(axis, this.marginM);
      const change = map.clearance(at.clone().add(nudge)) - map.clearance(at.clone().sub(nudge));
      return Number.isFinite(change) ? change : 0;
    });
    const normal = new Vector3(...(gradient as [number, number, number]));
    return normal.length() > 0 ? normal.normalize() : null;
  }

  /** Whether a path that begins at the origin of a map passes one of its surfaces. */
  private isCrossed(map: DepthMap, way: Viewpoint[]): boolean {
    const margin = this.marginM;
    return way.some(({ eye }, ix) => {
      const next = way[ix + 1]?.eye;
      if (!next) return false;
      const n = Math.min(MAX_STEPS, Math.ceil(eye.distanceTo(next) / (STEP_MARGINS * margin)));
      return Array.from({ length: n }, (_, step) => map.largestClearance(eye.clone().lerp(next, (step + 1) / n))).some(
        (clearance) => clearance < -margin && clearance > -MAX_DEPTH_MARGINS * margin,
      );
    });
  }
}

function copy({ eye, target }: Viewpoint): Viewpoint {
  return { eye: eye.clone(), target: target.clone() };
}
