// The depth of the keyframes as points. They move with the corrections of their keyframes, and disappear with them.

import * as THREE from "three";
import { worldFromCamera } from "../view/convention";
import { type Occlusion, ON_SURFACE } from "./occlusion";
import type { KeyframePointsHeader, NumberedKeyframe } from "../connection/protocol";

const SIZE_PX = 2.5;

export class PointsLayer {
  readonly root = new THREE.Group();
  private readonly material: THREE.PointsMaterial;
  private readonly byKeyframe = new Map<number, THREE.Points>();
  private poses = new Map<number, number[]>();
  private shownIds: ReadonlySet<number> | null = null;
  private isEnabled = false;

  constructor(occlusion: Occlusion) {
    this.material = occlusion.apply(
      new THREE.PointsMaterial({ size: SIZE_PX, sizeAttenuation: false, vertexColors: true }),
      ON_SURFACE,
    );
  }

  /**
   * Whether points are drawn. While they are not drawn, no points are kept. The server later sends
   * all of them again.
   */
  set enabled(enabled: boolean) {
    this.isEnabled = enabled;
    this.root.visible = enabled;
    if (!enabled) this.clear();
  }

  /** Whether there are points to draw. */
  get isVisible(): boolean {
    return this.isEnabled && this.byKeyframe.size > 0;
  }

  /** Adds the points of a keyframe, unless points are not drawn. */
  add(header: KeyframePointsHeader, payload: Uint8Array<ArrayBuffer>): void {
    if (!this.isEnabled) return;
    const pose = this.poses.get(header.id);
    if (!pose) return;
    this.remove(header.id);
    const nPositions = 3 * header.n_points;
    // A copy has the alignment that typed arrays need.
    const counts = new Int16Array(payload.slice(0, 2 * nPositions).buffer);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Int16BufferAttribute(counts, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(payload.slice(2 * nPositions), 3, true));
    const points = new THREE.Points(geometry, this.material);
    points.frustumCulled = false;
    points.matrixAutoUpdate = false;
    points.userData.scale = header.meters_per_count;
    points.visible = this.shownIds?.has(header.id) ?? true;
    this.place(points, pose);
    this.byKeyframe.set(header.id, points);
    this.root.add(points);
  }

  /** Adopts the poses of all keyframes. */
  setKeyframes(keyframes: NumberedKeyframe[]): void {
    this.poses = new Map(keyframes.map((keyframe) => [keyframe.id, keyframe.world_from_camera]));
    for (const [id, points] of this.byKeyframe) {
      const pose = this.poses.get(id);
      if (pose) this.place(points, pose);
      else this.remove(id);
    }
  }

  /** Draws only the points of these keyframes; of all if null. */
  showOnly(ids: ReadonlySet<number> | null): void {
    this.shownIds = ids;
    for (const [id, points] of this.byKeyframe) points.visible = ids?.has(id) ?? true;
  }

  clear(): void {
    for (const id of [...this.byKeyframe.keys()]) this.remove(id);
  }

  private place(points: THREE.Points, pose: number[]): void {
    const scale = points.userData.scale as number;
    points.matrix.copy(worldFromCamera(pose)).scale(new THREE.Vector3(scale, scale, scale));
    points.matrixWorldNeedsUpdate = true;
  }

  private remove(id: number): void {
    const points = this.byKeyframe.get(id);
    if (!points) return;
    points.geometry.dispose();
    this.root.remove(points);
    this.byKeyframe.delete(id);
  }
}
