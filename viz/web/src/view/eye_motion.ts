// Moves the eye and the point that it orbits. Motions by the user end before surfaces, but jumps do
// not.

import * as THREE from "three";
import type { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { DepthMap } from "../layers/depth_map";
import { type Block, blockOf } from "./block";
import { EyeGuard, type HitMesh, type Viewpoint } from "./eye_guard";

/** Duration of the motion back to the front of a surface. */
const RETURN_MILLIS = 250;
/** Time for which the eye may soon be at a surface, after it has come closer to its target or was stopped. */
const APPROACH_MILLIS = 1000;
/**
 * An orbit changes the distance to the target only by rounding errors. An approach reduces it to
 * less than this fraction.
 */
const MIN_APPROACH = 1 - 1e-6;
/** The zoom is at its end within this fraction of the distance. */
const END_FRAC = 0.999;

export class EyeMotion {
  /** What stopped the eye last, and when. */
  block: { what: Block; at: number } | null = null;
  private readonly guard: EyeGuard;
  /** The viewpoint after the last motion. */
  private readonly viewpoint: Viewpoint = { eye: new THREE.Vector3(), target: new THREE.Vector3() };
  private isPlacing = false;
  /** When the eye last came closer to its target, and when a surface or unknown space last stopped it. */
  private approachedAt = -Infinity;
  private stoppedAt = -Infinity;
  private returning: { from: Viewpoint; to: Viewpoint; began: number } | null = null;

  /**
   * @param isSolid whether surfaces stop the eye
   * @param onMove called after every motion; `isByUser` after those of the controls
   */
  constructor(
    private readonly camera: THREE.PerspectiveCamera,
    private readonly controls: OrbitControls,
    hitMesh: HitMesh,
    private readonly isSolid: () => boolean,
    private readonly onMove: (isByUser: boolean) => void,
  ) {
    this.guard = new EyeGuard(hitMesh);
    controls.addEventListener("change", () => this.moved());
    const roll = (event: Event): void => this.checkZoom((event as WheelEvent).deltaY);
    controls.domElement?.addEventListener("wheel", roll, { passive: true });
  }

  /** Distance of the near plane, meters. */
  set nearM(nearM: number) {
    this.guard.nearM = nearM;
  }

  /** Whether the eye may be at a surface within a moment, because it approaches its target or was stopped. */
  get isApproaching(): boolean {
    return performance.now() - this.approachedAt < APPROACH_MILLIS;
  }

  /** Whether a surface or unknown space has just stopped the eye. */
  get wasStopped(): boolean {
    return performance.now() - this.stoppedAt < APPROACH_MILLIS;
  }

  /** Radius around the eye without surfaces, meters; negative if it is not known. */
  get freeRadiusM(): number {
    return this.guard.freeRadiusM(this.camera.position);
  }

  /** Adopts newer knowledge of the model's surfaces, and returns to the front of them if the eye has passed one. */
  see(name: string, map: DepthMap): void {
    if (!this.isSolid() || this.returning) return;
    const good = this.guard.see(name, map);
    if (good) this.returning = { from: this.copyOfViewpoint(), to: good, began: performance.now() };
  }

  /** Forgets the surfaces of another model. */
  forgetSurfaces(): void {
    this.guard.forget();
  }

  /** Forgets the surroundings of the eye, because newer ones are not requested. */
  forgetSurroundings(): void {
    this.guard.forgetComplete();
  }

  /** Starts again at the present position, because surfaces now stop the eye, or no longer stop it. */
  forgetPlaces(): void {
    this.returning = null;
    this.guard.jump(this.viewpoint, false);
  }

  /** Records that the wheel cannot move the eye any further. */
  private checkZoom(deltaY: number): void {
    const { enabled, minDistance, maxDistance } = this.controls;
    const distanceM = this.camera.position.distanceTo(this.controls.target);
    const isAtFarEnd = deltaY > 0 && distanceM > END_FRAC * maxDistance;
    const isAtNearEnd = deltaY < 0 && END_FRAC * distanceM < minDistance;
    if (!enabled || !(isAtFarEnd || isAtNearEnd)) return;
    this.block = { what: { by: isAtFarEnd ? "far end" : "near end" }, at: performance.now() };
  }

  /** Called after each motion by the user. Stops the eye before surfaces. */
  moved(): void {
    if (this.isPlacing) return;
    const { position } = this.camera;
    const { target } = this.controls;
    if (this.returning) {
      this.place(this.copyOfViewpoint());
      return;
    }
    if (this.isAtViewpoint) return;
    const isShifted = !target.equals(this.viewpoint.target);
    const wanted = position.clone();
    const allowed = this.isSolid() ? this.guard.limit(position, isShifted) : position;
    const isCloser = position.distanceTo(target) < MIN_APPROACH * this.viewpoint.eye.distanceTo(target);
    if (!isShifted && isCloser) this.approachedAt = performance.now();
    if (!allowed.equals(position)) {
      this.stopped(wanted.sub(this.viewpoint.eye));
      // Eye and target move together in shifts; otherwise, the eye moves around the target or toward it.
      if (isShifted) target.add(allowed).sub(position);
      position.copy(allowed);
      this.camera.lookAt(target);
      if (this.isAtViewpoint) return;
    }
    this.guard.moved(this.adoptViewpoint());
    this.onMove(true);
  }

  private stopped(motion: THREE.Vector3): void {
    this.stoppedAt = performance.now();
    const forward = this.viewpoint.target.clone().sub(this.viewpoint.eye);
    this.block = { what: blockOf(motion, forward, this.guard.isStoppedBySurface), at: this.stoppedAt };
  }

  /** Looks from another place, which need not be reachable. */
  jump(viewpoint: Viewpoint): void {
    this.returning = null;
    this.place(viewpoint);
    this.guard.jump(this.viewpoint, false);
  }

  /** Adopts a pose that need not be upright. It is kept until the next motion. The camera looks at the target. */
  attach(pose: { eye: THREE.Vector3; target: THREE.Vector3; rotation: THREE.Quaternion }): void {
    this.returning = null;
    this.camera.position.copy(pose.eye);
    this.camera.quaternion.copy(pose.rotation);
    this.controls.target.copy(pose.target);
    this.guard.jump(this.adoptViewpoint(), false);
    this.onMove(false);
  }

  private place({ eye, target }: Viewpoint): void {
    this.camera.position.copy(eye);
    this.controls.target.copy(target);
    this.isPlacing = true;
    this.controls.update();
    this.isPlacing = false;
    this.adoptViewpoint();
    this.onMove(false);
  }

  /** Moves back to the front of a surface, and ignores other motions meanwhile. Called for every display refresh. */
  moveBack(): void {
    if (!this.returning) return;
    const { from, to, began } = this.returning;
    const share = THREE.MathUtils.smoothstep((performance.now() - began) / RETURN_MILLIS, 0, 1);
    const between = (get: (viewpoint: Viewpoint) => THREE.Vector3): THREE.Vector3 => get(from).clone().lerp(get(to), share);
    this.place({ eye: between(({ eye }) => eye), target: between(({ target }) => target) });
    if (share < 1) return;
    this.returning = null;
    this.guard.jump(this.viewpoint, true);
  }

  private get isAtViewpoint(): boolean {
    return this.camera.position.equals(this.viewpoint.eye) && this.controls.target.equals(this.viewpoint.target);
  }

  private adoptViewpoint(): Viewpoint {
    this.viewpoint.eye.copy(this.camera.position);
    this.viewpoint.target.copy(this.controls.target);
    return this.viewpoint;
  }

  private copyOfViewpoint(): Viewpoint {
    return { eye: this.viewpoint.eye.clone(), target: this.viewpoint.target.clone() };
  }
}
