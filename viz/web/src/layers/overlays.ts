// Lines over the picture: the floor grid, the world axes, frustums of keyframes and live cameras.

import * as THREE from "three";
import { worldFromCamera } from "../view/convention";
import { FRESH_MILLIS, freshness } from "./freshness";
import { uprightRotation } from "../view/up_axis";
import { type Occlusion, ON_SURFACE } from "./occlusion";
import type { NumberedKeyframe, PosedCamera, Scene } from "../connection/protocol";

/**
 * Colors of the newest keyframe, and of keyframes that are much older than AGE_SECS. The first
 * differs from the color of live cameras.
 */
const NEW_COLOR = new THREE.Color(0xc792ea);
const OLD_COLOR = new THREE.Color(0x9aa4b2);
/** The color of a keyframe of this age is halfway between both. */
const AGE_SECS = 10;
const LIVE_COLOR = 0x4cc2a6;
const SELECTED_COLOR = 0xe3b341;

/** Maximum length of the frustums of keyframes. In a hall, longer frustums would hide each other. */
const MAX_FRUSTUM_M = 0.2;

/** A pose in the world. */
export interface PosedFrame {
  worldFromFrame: THREE.Matrix4;
  isOutdated: boolean;
}

interface LiveCamera {
  lines: THREE.LineSegments;
  worldFromCamera: THREE.Matrix4;
  /** Changes whenever other lines must be drawn. */
  key: string;
  /** Mid-exposure of the newest image, on the server's clock. */
  capturedMillis: number;
  isOutdated: boolean;
}

export class Overlays {
  readonly root = new THREE.Group();
  private readonly ground = new THREE.Group();
  private readonly cameras = new THREE.Group();
  private readonly keyframes: THREE.LineSegments;
  private readonly live = new Map<string, LiveCamera>();
  private isLive = true;
  private readonly worldFromUpright = new THREE.Quaternion();
  private frustumDepth = 0.06;
  /** The frustum of the keyframe that the operator looks at. */
  private readonly selected: THREE.LineSegments;
  private posed: (PosedCamera | NumberedKeyframe)[] = [];
  private isInDepthBuffer = false;

  constructor(private readonly occlusion: Occlusion) {
    this.keyframes = this.lines(0xffffff, 0.45);
    (this.keyframes.material as THREE.LineBasicMaterial).vertexColors = true;
    this.keyframes.visible = false; // Hundreds of them would hide the scene.
    this.selected = this.lines(SELECTED_COLOR, 1);
    this.root.add(this.ground, this.cameras, this.keyframes, this.selected);
  }

  /** Grid, axes and live cameras. */
  set showsGround(visible: boolean) {
    this.ground.visible = visible;
    this.cameras.visible = visible;
  }

  /** Whether lines are in the depth buffer and drawn first, so that splats hide them and are hidden by them. */
  set writesDepth(writesDepth: boolean) {
    this.isInDepthBuffer = writesDepth;
    this.root.renderOrder = writesDepth ? -1 : 0;
    this.root.traverse((object) => {
      if (object instanceof THREE.LineSegments) (object.material as THREE.Material).depthWrite = writesDepth;
    });
  }

  /** Whether there are lines to draw. */
  get isVisible(): boolean {
    return this.ground.visible || this.keyframes.visible;
  }

  set showsKeyframes(visible: boolean) {
    this.keyframes.visible = visible;
    this.drawKeyframes();
  }

  /** Makes the grid perpendicular to another direction of up. */
  setUp(up: THREE.Vector3, scene: Scene | null): void {
    this.worldFromUpright.copy(uprightRotation(up));
    if (scene) this.setScene(scene);
  }

  /** Creates grid and axes for a scene of this size. */
  setScene(scene: Scene): void {
    this.frustumDepth = Math.min(0.12 * scene.radius_m, MAX_FRUSTUM_M);
    // A round cell size close to a fifth of the radius.
    const cell = 10 ** Math.round(Math.log10(scene.radius_m / 5));
    const nCells = 2 * Math.ceil((1.6 * scene.radius_m) / cell);
    for (const child of this.ground.children) (child as THREE.LineSegments).geometry.dispose();
    this.ground.clear();
    const grid = new THREE.GridHelper(nCells * cell, nCells, 0x9fb0c3, 0x9fb0c3);
    grid.rotateX(Math.PI / 2);
    const center = new THREE.Vector3(...scene.center_m).applyQuaternion(this.worldFromUpright.clone().invert());
    const middle = [center.x, center.y].map((value) => Math.round(value / cell) * cell);
    grid.position.set(middle[0]!, middle[1]!, 0).applyQuaternion(this.worldFromUpright);
    grid.quaternion.premultiply(this.worldFromUpright);
    Object.assign(grid.material, { transparent: true, opacity: 0.22, depthWrite: this.isInDepthBuffer });
    const axesHelper = axes(2 * cell);
    for (const drawn of [grid, axesHelper]) this.occlusion.apply(drawn.material as THREE.Material, ON_SURFACE);
    this.ground.add(grid, axesHelper);
  }

  /** Draws the frustums of keyframes, colored by age relative to the newest one. */
  setKeyframes(keyframes: (PosedCamera | NumberedKeyframe)[]): void {
    this.posed = keyframes;
    this.drawKeyframes();
  }

  /** The keyframes whose frustums are drawn, and how deep these are, meters. */
  get drawnKeyframes(): { keyframes: (PosedCamera | NumberedKeyframe)[]; depthM: number } {
    return { keyframes: this.keyframes.visible ? this.posed : [], depthM: this.frustumDepth };
  }

  /** How deep the frustums of live cameras are, meters. */
  get liveFrustumDepthM(): number {
    return 1.6 * this.frustumDepth;
  }

  /** Draws the frustum of this keyframe larger and in another color, even if the others are hidden. */
  select(keyframe: PosedCamera | null): void {
    setLines(this.selected, keyframe ? frustum(keyframe, 1.3 * this.frustumDepth) : []);
  }

  /** Builds the frustums only if they are visible, because the list changes several times per second. */
  private drawKeyframes(): void {
    if (!this.keyframes.visible) return;
    const keyframes = this.posed;
    const frustums = keyframes.map((keyframe) => frustum(keyframe, this.frustumDepth));
    setLines(this.keyframes, frustums.flat());
    const secs = keyframes.map((keyframe) => ("stamp_nanos" in keyframe ? keyframe.stamp_nanos * 1e-9 : 0));
    const newest = secs.reduce((max, value) => Math.max(max, value), -Infinity);
    const colors = frustums.flatMap((points, ix) => {
      const color = OLD_COLOR.clone().lerp(NEW_COLOR, 0.5 ** ((newest - secs[ix]!) / AGE_SECS));
      return points.flatMap(() => color.toArray());
    });
    this.keyframes.geometry.setAttribute("color", new THREE.Float32BufferAttribute(colors, 3));
  }

  /** Sets whether the connection is open; if not, the poses of the live cameras are not current. */
  setLive(isLive: boolean): void {
    this.isLive = isLive;
  }

  /** Draws live cameras more faintly if their newest image is older. Returns whether this is a change. */
  showAges(ageMillis: (capturedMillis: number) => number): boolean {
    let isChange = false;
    for (const camera of this.live.values()) {
      const age = this.isLive ? ageMillis(camera.capturedMillis) : Infinity;
      const material = camera.lines.material as THREE.LineBasicMaterial;
      const opacity = freshness(age);
      isChange ||= material.opacity !== opacity;
      material.opacity = opacity;
      camera.isOutdated = age > FRESH_MILLIS;
    }
    return isChange;
  }

  /** Removes the live cameras, because a new server may have others. */
  forgetLive(): void {
    for (const { lines } of this.live.values()) {
      lines.geometry.dispose();
      (lines.material as THREE.LineBasicMaterial).dispose();
      lines.removeFromParent();
    }
    this.live.clear();
  }

  /** Poses of the live cameras in the world. */
  cameraPoses(): [string, PosedFrame][] {
    const posed = ({ worldFromCamera: worldFromFrame, isOutdated }: LiveCamera): PosedFrame => ({ worldFromFrame, isOutdated });
    return [...this.live].map(([name, camera]) => [name, posed(camera)]);
  }

  /** Draws a camera at its pose when an image was captured; returns whether the pose changed. */
  setLiveCamera(camera: PosedCamera, capturedMillis: number): boolean {
    const key = [...camera.world_from_camera, ...camera.focal_px, this.frustumDepth].join();
    const before = this.live.get(camera.camera);
    if (before) before.capturedMillis = capturedMillis;
    if (before?.key === key) return false;
    const lines = before?.lines ?? this.lines(LIVE_COLOR, 1);
    if (!before) this.cameras.add(lines);
    const isOutdated = before?.isOutdated ?? false;
    const pose = worldFromCamera(camera.world_from_camera);
    this.live.set(camera.camera, { lines, worldFromCamera: pose, key, capturedMillis, isOutdated });
    setLines(lines, frustum(camera, this.liveFrustumDepthM));
    return true;
  }

  private lines(color: number, opacity: number): THREE.LineSegments {
    const material = new THREE.LineBasicMaterial({ color, opacity, transparent: true, depthWrite: this.isInDepthBuffer });
    const segments = new THREE.LineSegments(new THREE.BufferGeometry(), this.occlusion.apply(material, ON_SURFACE));
    segments.frustumCulled = false;
    return segments;
  }
}

function setLines(target: THREE.LineSegments, points: THREE.Vector3[]): void {
  target.geometry.dispose();
  target.geometry = new THREE.BufferGeometry().setFromPoints(points);
}

/** Axes of a frame: x red, y green, z blue. */
export function axes(length: number): THREE.LineSegments {
  const helper = new THREE.AxesHelper(length);
  helper.setColors(0xf0716a, 0x7bd88f, 0x6cb6ff);
  helper.renderOrder = 1;
  return helper;
}

/** Ends of the edges of a frustum and of a small roof on its upper side, in world. */
export function frustum(camera: PosedCamera, depth: number): THREE.Vector3[] {
  const pose = worldFromCamera(camera.world_from_camera);
  const [width, height] = camera.size_px;
  const at = (u: number, v: number): THREE.Vector3 =>
    new THREE.Vector3(
      ((u - camera.principal_px[0]) / camera.focal_px[0]) * depth,
      ((v - camera.principal_px[1]) / camera.focal_px[1]) * depth,
      depth,
    ).applyMatrix4(pose);
  const eye = new THREE.Vector3().applyMatrix4(pose);
  const corners = [at(0, 0), at(width, 0), at(width, height), at(0, height)];
  const edges = corners.flatMap((corner, ix) => [eye, corner, corner, corners[(ix + 1) % 4]!]);
  const [left, right, top] = [at(0.35 * width, 0), at(0.65 * width, 0), at(0.5 * width, -0.2 * height)];
  return [...edges, left, top, top, right];
}
