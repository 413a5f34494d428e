// What the view moves with: a frame of the robot, or one of its cameras.

import * as THREE from "three";
import { Chase, viewFromBehind } from "./chase";
import type { EyeMotion } from "./eye_motion";
import { BASE_FRAME, linkOf } from "./frame_chooser";
import { headingOfBase } from "./overview";
import type { PosedCamera } from "../connection/protocol";
import { lensDegrees, Ride } from "./ride";
import type { RobotLayer } from "../layers/robot_layer";
import type { SceneViews } from "./scene_views";

/** Maximum time of one step. After a longer pause, the view moves only as far as in this time. */
const MAX_STEP_SECS = 0.2;

export class Attachment {
  /** The frame that is followed, see frame_chooser.ts. */
  private followed = BASE_FRAME;
  private chases = false;
  private ridden: string | null = null;
  /** Field of view to return to after the ride, degrees. */
  private ownFovDegrees: number | null = null;
  private readonly chase = new Chase();
  private readonly ride = new Ride();
  /** The newest image of each camera with a pose. */
  private readonly cameras = new Map<string, PosedCamera>();
  private updatedAt = performance.now();

  constructor(
    private readonly eye: THREE.PerspectiveCamera,
    private readonly target: THREE.Vector3,
    private readonly motion: EyeMotion,
    private readonly robot: RobotLayer,
    private readonly sceneViews: SceneViews,
  ) {}

  /** Whether the view moves with something. */
  get isOn(): boolean {
    return this.chases || this.ridden !== null;
  }

  get isChasing(): boolean {
    return this.chases;
  }

  /** The camera that the view is attached to; null if there is none. */
  get riddenCamera(): string | null {
    return this.ridden;
  }

  /** Cameras whose poses are known. */
  get cameraNames(): string[] {
    return [...this.cameras.keys()];
  }

  /** Field of view without the lens of a camera, degrees. */
  get fovDegrees(): number {
    return this.ownFovDegrees ?? this.eye.fov;
  }

  get frame(): string {
    return this.followed;
  }

  /** Follows another frame from now on. */
  set frame(frame: string) {
    this.followed = frame;
    this.chase.restart();
  }

  /** Adopts a newer pose of a camera. */
  seen(camera: PosedCamera): void {
    this.cameras.set(camera.camera, camera);
  }

  /** Forgets the cameras, because a new server may have others. */
  forgetCameras(): void {
    this.cameras.clear();
  }

  /** Moves with the followed frame. If the robot is not in the picture, the view first moves behind the robot. */
  startChase(isRobotVisible: boolean): void {
    this.end();
    this.chases = true;
    this.chase.restart();
    const base = linkOf(BASE_FRAME, this.robot);
    const worldFromBase = base === null ? null : this.robot.linkPose(base);
    if (isRobotVisible || !worldFromBase) return;
    const box = this.robot.box();
    const sizeM = box.getSize(new THREE.Vector3()).length();
    this.motion.jump(viewFromBehind(box.getCenter(new THREE.Vector3()), sizeM, headingOfBase(worldFromBase)));
  }

  /** Attaches the view to a camera, as soon as its pose is known. */
  startRide(camera: string): void {
    this.chases = false;
    this.ownFovDegrees ??= this.eye.fov;
    this.ridden = camera;
    this.ride.restart();
  }

  /** Detaches the view; it stays where it is, with its own field of view. */
  end(): void {
    this.chases = false;
    this.endRide();
  }

  /** Called when the user moves the view. The view leaves the camera, but continues to follow the robot. */
  endRide(): void {
    if (this.ownFovDegrees !== null) this.setFov(this.ownFovDegrees);
    this.ownFovDegrees = null;
    this.ridden = null;
  }

  /** Moves the view; called for every display refresh. */
  update(): void {
    const now = performance.now();
    const secs = Math.min(MAX_STEP_SECS, (now - this.updatedAt) / 1000);
    this.updatedAt = now;
    if (this.ridden !== null) this.moveWithCamera(this.ridden, secs);
    else if (this.chases) this.moveWithRobot(secs);
  }

  private moveWithCamera(name: string, secs: number): void {
    const camera = this.cameras.get(name);
    if (!camera) return;
    const isZoomed = this.setFov(lensDegrees(camera, this.eye.aspect));
    const moved = this.ride.update(camera, (eye, forward) => this.sceneViews.distanceAhead(eye, forward), secs);
    if (moved || isZoomed) this.motion.attach(moved ?? this.current());
  }

  private moveWithRobot(secs: number): void {
    const link = linkOf(this.followed, this.robot);
    const worldFromLink = link === null ? null : this.robot.linkPose(link);
    const view = { eye: this.eye.position, target: this.target };
    const moved = worldFromLink && this.chase.update(view, worldFromLink, secs);
    if (moved) this.motion.jump(moved);
  }

  private current(): { eye: THREE.Vector3; target: THREE.Vector3; rotation: THREE.Quaternion } {
    return { eye: this.eye.position.clone(), target: this.target.clone(), rotation: this.eye.quaternion.clone() };
  }

  private setFov(degrees: number): boolean {
    if (Math.abs(degrees - this.eye.fov) < 1e-9) return false;
    this.eye.fov = degrees;
    this.eye.updateProjectionMatrix();
    return true;
  }
}
