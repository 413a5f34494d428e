// The main view: free camera, newest picture, lines on top.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { pinholeOfThreeCamera, poseOfThreeCamera, worldFromCamera } from "./convention";
import { Overlays } from "./overlays";
import { PictureLayer } from "./picture_layer";
import type { Scene } from "./protocol";
import type { View } from "./render_scheduler";

const VERTICAL_FOV_DEGREES = 50;
/** Larger windows are rendered at this width and upscaled. */
const MAX_PICTURE_WIDTH_PX = 1280;
/** The color --ground in app.css. */
export const BACKGROUND: [number, number, number] = [0x0b / 255, 0x0e / 255, 0x13 / 255];

export class OrbitView {
  readonly picture = new PictureLayer();
  readonly overlays = new Overlays();
  private readonly camera = new THREE.PerspectiveCamera(VERTICAL_FOV_DEGREES, 1, 0.01, 200);
  private readonly world = new THREE.Scene();
  private readonly renderer: THREE.WebGLRenderer;
  private readonly controls: OrbitControls;
  private scene: Scene | null = null;
  private hasUserMoved = false;
  private isStale = true;

  constructor(private readonly canvas: HTMLCanvasElement, onMove: () => void) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    // Colors arrive as sRGB and are output unchanged.
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    THREE.ColorManagement.enabled = false;
    this.renderer.setClearColor(new THREE.Color(...BACKGROUND));
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(1, -1, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => {
      this.isStale = true;
      onMove();
    });
    this.controls.addEventListener("start", () => (this.hasUserMoved = true));
    this.world.add(this.picture.mesh, this.overlays.root);
    new ResizeObserver(() => {
      this.fit();
      onMove();
    }).observe(canvas.parentElement!);
    this.fit();
  }

  /** Adopts a scene; the camera moves to its initial view unless the user has moved it. */
  setScene(scene: Scene): void {
    const isNew = JSON.stringify(scene) !== JSON.stringify(this.scene);
    this.scene = scene;
    if (!isNew) return;
    this.isStale = true;
    this.overlays.setScene(scene);
    this.camera.near = Math.max(0.005 * scene.radius_m, 0.005);
    this.camera.far = 400 * this.camera.near + 40 * scene.radius_m;
    this.camera.updateProjectionMatrix();
    this.controls.minDistance = 2 * this.camera.near;
    this.controls.maxDistance = 12 * scene.radius_m;
    if (!this.hasUserMoved) this.reset();
  }

  /** Returns to the scene's initial view. */
  reset(): void {
    if (this.scene) this.lookFrom(this.scene.world_from_camera);
  }

  /** Looks along a camera's axis, upright, and orbits the point on it that is closest to the scene's center. */
  lookFrom(rowMajor: number[]): void {
    const pose = worldFromCamera(rowMajor);
    const eye = new THREE.Vector3().setFromMatrixPosition(pose);
    const forward = new THREE.Vector3().setFromMatrixColumn(pose, 2);
    const center = new THREE.Vector3(...(this.scene?.center_m ?? [0, 0, 0]));
    const along = Math.max(center.sub(eye).dot(forward), 0.2 * (this.scene?.radius_m ?? 1));
    this.camera.position.copy(eye);
    this.controls.target.copy(eye).addScaledVector(forward, along);
    this.controls.update();
  }

  /** The current view. */
  view(): View {
    const scale = Math.min(1, MAX_PICTURE_WIDTH_PX / this.canvas.width);
    const size_px: [number, number] = [
      Math.max(1, Math.round(this.canvas.width * scale)),
      Math.max(1, Math.round(this.canvas.height * scale)),
    ];
    return {
      world_from_camera: poseOfThreeCamera(this.camera),
      size_px,
      projection: pinholeOfThreeCamera(this.camera, size_px),
      near_m: this.camera.near,
      far_m: this.camera.far,
    };
  }

  /** Depth at which pixels without any model are placed. */
  get emptyDepth(): number {
    return 0.9 * this.camera.far;
  }

  /** Marks the view as changed. */
  changed(): void {
    this.isStale = true;
  }

  /** Draws only if something has changed: on a robot's computer the page shares the cores with other programs. */
  draw(): void {
    if (!this.isStale) return;
    this.isStale = false;
    this.renderer.render(this.world, this.camera);
  }

  private fit(): void {
    const { clientWidth, clientHeight } = this.canvas.parentElement!;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / Math.max(1, clientHeight);
    this.camera.updateProjectionMatrix();
    this.isStale = true;
  }
}
