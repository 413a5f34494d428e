// Measures the distance between two points of the model's surface that the user clicks on.

import * as THREE from "three";
import { element } from "../panels/element";

const COLOR = 0xe3b341;
/** Radius of a point, relative to its distance from the viewer. */
const POINT_SIZE = 0.006;
/** Longer movements between press and release are drags. */
const MAX_CLICK_PX = 4;

export class MeasureTool {
  readonly root = new THREE.Group();
  private readonly label = element("distance");
  private readonly line: THREE.Line;
  private readonly spheres: THREE.Mesh[];
  private points: THREE.Vector3[] = [];
  private pressed: [number, number] | null = null;

  constructor(
    private readonly camera: THREE.PerspectiveCamera,
    private readonly canvas: HTMLCanvasElement,
    private readonly surfaceAt: (x: number, y: number) => THREE.Vector3 | null,
    private readonly changed: () => void,
  ) {
    // Always visible, like the handles of the crop box.
    const onTop = { color: COLOR, depthTest: false, transparent: true };
    this.line = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial(onTop));
    this.line.frustumCulled = false;
    const sphere = new THREE.SphereGeometry(1, 16, 12);
    this.spheres = [0, 1].map(() => new THREE.Mesh(sphere, new THREE.MeshBasicMaterial(onTop)));
    for (const drawn of [this.line, ...this.spheres]) drawn.renderOrder = 3;
    this.root.add(this.line, ...this.spheres);
    this.root.visible = false;
    canvas.addEventListener("pointerdown", (event) => {
      this.pressed = event.isPrimary && event.button === 0 ? [event.offsetX, event.offsetY] : null;
    });
    canvas.addEventListener("pointerup", (event) => this.release(event));
    this.setPoints([]);
  }

  /** Whether clicks set points. Switching the tool off removes them. */
  set enabled(enabled: boolean) {
    this.root.visible = enabled;
    this.setPoints([]);
  }

  /** Places the label, and gives the points their size on the screen. */
  update(): void {
    if (!this.root.visible) return;
    for (const sphere of this.spheres) {
      sphere.scale.setScalar(POINT_SIZE * sphere.position.distanceTo(this.camera.position));
    }
    const [from, to] = this.points;
    if (!from || !to) return;
    const middle = from.clone().lerp(to, 0.5).project(this.camera);
    this.label.hidden = middle.z > 1; // Behind the viewer.
    this.label.style.left = `${(50 * (1 + middle.x)).toFixed(2)}%`;
    this.label.style.top = `${(50 * (1 - middle.y)).toFixed(2)}%`;
  }

  private release(event: PointerEvent): void {
    const pressed = this.pressed;
    this.pressed = null;
    if (!this.root.visible || !pressed) return;
    if (Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) > MAX_CLICK_PX) return;
    const point = this.surfaceAt(event.offsetX, event.offsetY);
    if (!point) {
      this.label.hidden = false;
      this.label.textContent = "no surface here";
      this.label.style.left = `${((100 * event.offsetX) / this.canvas.clientWidth).toFixed(2)}%`;
      this.label.style.top = `${((100 * event.offsetY) / this.canvas.clientHeight).toFixed(2)}%`;
      return;
    }
    this.setPoints(this.points.length === 1 ? [this.points[0]!, point] : [point]);
  }

  private setPoints(points: THREE.Vector3[]): void {
    this.points = points;
    this.spheres.forEach((sphere, ix) => {
      sphere.visible = ix < points.length;
      if (points[ix]) sphere.position.copy(points[ix]);
    });
    this.line.visible = points.length === 2;
    this.line.geometry.dispose();
    this.line.geometry = new THREE.BufferGeometry().setFromPoints(points);
    const [from, to] = points;
    this.label.hidden = !to;
    if (from && to) this.label.textContent = distanceText(from, to);
    this.changed();
  }
}

function distanceText(from: THREE.Vector3, to: THREE.Vector3): string {
  const [x, y, z] = to.clone().sub(from).toArray() as [number, number, number];
  return `${lengthText(from.distanceTo(to))} (horizontal ${lengthText(Math.hypot(x, y))}, vertical ${lengthText(Math.abs(z))})`;
}

function lengthText(meters: number): string {
  return meters < 1 ? `${(1000 * meters).toFixed(0)} mm` : `${meters.toFixed(2)} m`;
}
