// A camera path through views that the user has added: plays it, and saves it in nerfstudio's format.

import * as THREE from "three";

export const FRAMES_PER_SEC = 30;
const SECS_PER_SEGMENT = 2;

/** A view of an upright camera that looks at a point. */
export interface PathView {
  position: THREE.Vector3;
  target: THREE.Vector3;
  fovDegrees: number;
}

export class CameraPath {
  private readonly views: PathView[] = [];
  private startedAt: number | null = null;

  get nViews(): number {
    return this.views.length;
  }

  get isPlaying(): boolean {
    return this.startedAt !== null;
  }

  /** The views of the path, in order. */
  get all(): readonly PathView[] {
    return this.views;
  }

  add(view: PathView): void {
    this.views.push({ ...view, position: view.position.clone(), target: view.target.clone() });
  }

  clear(): void {
    this.views.length = 0;
    this.startedAt = null;
  }

  play(): void {
    if (this.views.length > 1) this.startedAt = performance.now();
  }

  stop(): void {
    this.startedAt = null;
  }

  /** The view of the playback now; null if nothing is played. */
  current(): PathView | null {
    if (this.startedAt === null) return null;
    const segments = (performance.now() - this.startedAt) / 1000 / SECS_PER_SEGMENT;
    if (segments >= this.views.length - 1) this.startedAt = null;
    return this.at(segments);
  }

  /** The views of the playback, `FRAMES_PER_SEC` of them per second. */
  frames(): PathView[] {
    const nFrames = Math.round(this.seconds * FRAMES_PER_SEC) + 1;
    return Array.from({ length: nFrames }, (_, ix) => this.at(ix / FRAMES_PER_SEC / SECS_PER_SEGMENT));
  }

  private get seconds(): number {
    return Math.max(0, this.views.length - 1) * SECS_PER_SEGMENT;
  }

  /** The path as a file for `fieldrig render --camera-path` and for nerfstudio. */
  file([width, height]: [number, number]): string {
    return JSON.stringify({
      camera_type: "perspective",
      render_width: width,
      render_height: height,
      fps: FRAMES_PER_SEC,
      seconds: this.seconds,
      camera_path: this.frames().map((view) => ({
        camera_to_world: rowMajor(worldFromOpengl(view)),
        fov: view.fovDegrees,
        aspect: width / height,
      })),
    });
  }

  /** The view after this number of segments; a Catmull-Rom spline through all views. */
  private at(segments: number): PathView {
    const last = this.views.length - 1;
    const from = Math.min(Math.max(0, Math.floor(segments)), Math.max(0, last - 1));
    const t = Math.min(Math.max(0, segments - from), 1);
    const near = [from - 1, from, from + 1, from + 2].map((ix) => this.views[Math.min(Math.max(0, ix), last)]!);
    const spline = (get: (view: PathView) => number): number =>
      catmullRom(near.map(get) as [number, number, number, number], t);
    const point = (get: (view: PathView) => THREE.Vector3): THREE.Vector3 =>
      new THREE.Vector3(...([0, 1, 2] as const).map((axis) => spline((view) => get(view).getComponent(axis))));
    return {
      position: point((view) => view.position),
      target: point((view) => view.target),
      fovDegrees: spline((view) => view.fovDegrees),
    };
  }
}

function catmullRom([a, b, c, d]: [number, number, number, number], t: number): number {
  return b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)));
}

/** Pose of an upright camera that looks along its -z axis. */
function worldFromOpengl({ position, target }: PathView): THREE.Matrix4 {
  return new THREE.Matrix4().lookAt(position, target, new THREE.Vector3(0, 0, 1)).setPosition(position);
}

function rowMajor(matrix: THREE.Matrix4): number[] {
  return matrix.clone().transpose().toArray();
}
