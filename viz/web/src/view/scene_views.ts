// Views that depend on the positions of the scene, the robot and its path: the overview, the view
// from above, and the view from the front.

import * as THREE from "three";
import type { Viewpoint } from "./eye_guard";
import {
  boundsOf,
  cornersOf,
  frontDirection,
  headingOfBase,
  headingOfCamera,
  type Lens,
  topDirection,
  viewOf,
} from "./overview";
import { type Heading, OverviewKeeper } from "./overview_keeper";
import type { RobotLayer } from "../layers/robot_layer";
import type { ScanLayer } from "../layers/scan_layer";
import type { Scene } from "../connection/protocol";

/**
 * Maximum size of the details that a user looks at, even in a hall. The near plane, the frames and
 * the speed depend on this size.
 */
const MAX_DETAIL_M = 2;
/** Minimum distance of the point that a view from a camera orbits, in sizes of details. */
const MIN_AHEAD = 0.2;
/** Time between two checks whether everything is still in the overview. */
const CHECK_MILLIS = 250;

export class SceneViews {
  scene: Scene | null = null;
  private readonly keeper = new OverviewKeeper();
  private checkedAt = -Infinity;

  constructor(
    private readonly camera: THREE.PerspectiveCamera,
    private readonly robot: RobotLayer,
    private readonly scans: ScanLayer,
  ) {}

  /** Size of the details that a user looks at, meters. */
  get detailM(): number {
    return Math.min(this.radiusM, MAX_DETAIL_M);
  }

  /** Radius of the scene, meters. */
  get radiusM(): number {
    return this.scene?.radius_m ?? 1;
  }

  /** Distance along a line of sight to the point that is closest to the scene's center. */
  distanceAhead(eye: THREE.Vector3, forward: THREE.Vector3): number {
    const center = new THREE.Vector3(...(this.scene?.center_m ?? [0, 0, 0]));
    return Math.max(center.sub(eye).dot(forward), MIN_AHEAD * this.detailM);
  }

  /** A view of everything from above, or from the front of the robot; null if nothing is known. */
  along(direction: "top" | "front"): Viewpoint | null {
    const corners = cornersOf(this.contents());
    if (corners.length === 0) return null;
    const { rad, isRobot } = this.heading();
    const forward = direction === "top" ? topDirection() : frontDirection(isRobot ? rad : null);
    return viewOf(corners, forward, this.lens);
  }

  /** Begins with the overview in the present heading. */
  restartOverview(): void {
    this.keeper.restart();
    this.checkedAt = -Infinity;
  }

  /** Fits everything into the picture again, because the shape of the picture has changed. */
  refitOverview(): void {
    this.keeper.refit();
  }

  /** A new overview if one is needed; otherwise null. Called for every display refresh. */
  overview(): Viewpoint | null {
    const now = performance.now();
    if (now - this.checkedAt < CHECK_MILLIS) return null;
    this.checkedAt = now;
    return this.keeper.update(this.contents(), this.heading(), this.lens);
  }

  /** A box around the robot; empty if it is not shown. */
  robotBox(): THREE.Box3 {
    return this.robot.isVisible ? this.robot.box() : new THREE.Box3();
  }

  /** Boxes around everything that is visible. */
  private contents(): THREE.Box3[] {
    const scene = this.scene ? boundsOf(this.scene) : new THREE.Box3();
    return [scene, this.robotBox(), this.scans.pathBox];
  }

  private heading(): Heading {
    const { namedLinks } = this.robot;
    const worldFromBase = namedLinks && this.robot.linkPose(namedLinks.base);
    if (worldFromBase) return { rad: headingOfBase(worldFromBase), isRobot: true };
    return { rad: this.scene ? headingOfCamera(this.scene.world_from_camera) : 0, isRobot: false };
  }

  private get lens(): Lens {
    const { fov, aspect, up } = this.camera;
    return { fovDegrees: fov, aspect, up };
  }
}
