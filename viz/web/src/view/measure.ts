// Measures distances between points of the model's surface that the user clicks on.

import * as THREE from "three";
import { isKeptByFocus, isPageCovered } from "../keys";
import { inDeviceWords } from "../panels/devices";
import { element } from "../panels/element";
import { child, make } from "../panels/html";
import { clearBottomPx } from "./clear_part";
import { placeLabel } from "./label_places";

const COLOR = 0xe3b341;
/** Radius of a point, relative to its distance from the viewer. */
const POINT_SIZE = 0.006;
/** Longer movements between press and release are drags. */
const MAX_CLICK_PX = 4;

const FIRST_POINT = "Click on two points of the model to measure their distance.";
const SECOND_POINT = "Click on the second point. Esc cancels.";
const NEXT_POINT = "Click on two points for the next distance. Delete removes the last distance.";
const NO_SURFACE = "No surface there. Click on the model.";

/** Two points and their distance. */
interface Measurement {
  root: THREE.Group;
  ends: [THREE.Mesh, THREE.Mesh];
  label: HTMLElement;
}

export class MeasureTool {
  readonly root = new THREE.Group();
  private readonly hint = element("measure-hint");
  private readonly labels = element("distances");
  private readonly sphere = new THREE.SphereGeometry(1, 16, 12);
  // The material is always visible, like the handles of the crop box.
  private readonly pointMaterial = new THREE.MeshBasicMaterial({ color: COLOR, depthTest: false, transparent: true });
  private readonly previewMaterial = new THREE.MeshBasicMaterial({ color: COLOR, depthTest: false, transparent: true, opacity: 0.6 });
  private readonly lineMaterial = new THREE.LineBasicMaterial({ color: COLOR, depthTest: false, transparent: true });
  private readonly measurements: Measurement[] = [];
  /** The first point of the next measurement. */
  private begun: THREE.Mesh | null = null;
  private pressed: [number, number] | null = null;
  /** Where the pointer is, in pixels of the canvas; null if it is elsewhere or drags. */
  private pointer: [number, number] | null = null;
  /** Shows which point a click would set. */
  private readonly preview: THREE.Mesh;

  constructor(
    private readonly camera: THREE.PerspectiveCamera,
    private readonly canvas: HTMLCanvasElement,
    private readonly surfaceAt: (x: number, y: number) => THREE.Vector3 | null,
    private readonly changed: () => void,
  ) {
    this.root.visible = false;
    this.preview = this.pointAt(new THREE.Vector3());
    this.preview.material = this.previewMaterial;
    this.root.add(this.preview);
    canvas.addEventListener("pointerdown", (event) => {
      this.pressed = event.isPrimary && event.button === 0 ? [event.offsetX, event.offsetY] : null;
    });
    canvas.addEventListener("pointermove", (event) => {
      // A finger covers the point, and does not move before it presses.
      const isFree = event.buttons === 0 && event.pointerType !== "touch";
      this.moveTo(isFree ? [event.offsetX, event.offsetY] : null);
    });
    canvas.addEventListener("pointerleave", () => this.moveTo(null));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    // This listener runs before other listeners, so that Delete has only one effect.
    window.addEventListener("keydown", (event) => this.keyDown(event), { capture: true });
  }

  /** Whether clicks set points, and whether the measurements are shown. */
  set enabled(enabled: boolean) {
    this.root.visible = enabled;
    this.canvas.classList.toggle("measuring", enabled);
    this.hint.hidden = !enabled;
    this.labels.hidden = !enabled;
    this.pointer = null;
    this.cancel();
    this.update();
  }

  /** Removes all measurements. */
  clear(): void {
    this.cancel();
    while (this.measurements.length > 0) this.remove(this.measurements[0]!);
  }

  get enabled(): boolean {
    return this.root.visible;
  }

  private moveTo(pointer: [number, number] | null): void {
    if (!this.root.visible || pointer === this.pointer) return;
    this.pointer = pointer;
    this.changed();
  }

  /** Moves the preview to the surface at the pointer, which changes with the view and the picture, too. */
  private showPreview(): void {
    const point = this.pointer && this.surfaceAt(...this.pointer);
    this.preview.visible = point !== null;
    if (point) this.preview.position.copy(point);
    this.canvas.dataset.surface = String(point !== null);
  }

  /** Places the labels, and gives the points their size on the screen. */
  update(): void {
    if (!this.root.visible) return;
    this.camera.updateMatrixWorld();
    this.showPreview();
    for (const sphere of [...this.spheres(), this.preview]) {
      sphere.scale.setScalar(POINT_SIZE * sphere.position.distanceTo(this.camera.position));
    }
    const points = this.spheres().map(({ position }) => this.onScreen(position));
    const inView = points.filter((point) => point !== null);
    for (const { ends, label } of this.measurements) {
      const [from, to] = ends.map(({ position }) => this.onScreen(position));
      label.hidden = !from || !to;
      if (!from || !to) continue;
      const size = { width: label.offsetWidth, height: label.offsetHeight };
      const view = { left: 0, top: 0, right: this.canvas.clientWidth, bottom: clearBottomPx(this.canvas) };
      const { x, y } = placeLabel([from, to], size, view, inView);
      label.style.left = `${x.toFixed(1)}px`;
      label.style.top = `${y.toFixed(1)}px`;
    }
  }

  private spheres(): THREE.Mesh[] {
    const all = this.measurements.flatMap(({ ends }) => ends);
    return this.begun ? [...all, this.begun] : all;
  }

  /** A point in pixels of the canvas; null behind the viewer. */
  private onScreen(point: THREE.Vector3): { x: number; y: number } | null {
    const ndc = point.clone().project(this.camera);
    if (ndc.z > 1) return null;
    const { clientWidth, clientHeight } = this.canvas;
    return { x: 0.5 * (1 + ndc.x) * clientWidth, y: 0.5 * (1 - ndc.y) * clientHeight };
  }

  private release(event: PointerEvent): void {
    const pressed = this.pressed;
    this.pressed = null;
    if (!this.root.visible || !pressed) return;
    if (Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) > MAX_CLICK_PX) return;
    const point = this.surfaceAt(event.offsetX, event.offsetY);
    if (point) this.addPoint(point);
    else this.hint.textContent = inDeviceWords(NO_SURFACE);
  }

  private addPoint(point: THREE.Vector3): void {
    const sphere = this.pointAt(point);
    const { begun } = this;
    this.begun = begun ? null : sphere;
    if (begun) this.finish(begun, sphere);
    else this.root.add(sphere);
    this.showHint();
    this.changed();
  }

  private pointAt(point: THREE.Vector3): THREE.Mesh {
    const sphere = new THREE.Mesh(this.sphere, this.pointMaterial);
    sphere.position.copy(point);
    sphere.renderOrder = 3;
    return sphere;
  }

  private finish(from: THREE.Mesh, to: THREE.Mesh): void {
    const geometry = new THREE.BufferGeometry().setFromPoints([from.position, to.position]);
    const line = new THREE.Line(geometry, this.lineMaterial);
    line.frustumCulled = false;
    line.renderOrder = 3;
    const root = new THREE.Group();
    root.add(line, from, to);
    this.root.add(root);
    const measurement: Measurement = { root, ends: [from, to], label: make("div", { className: "distance" }) };
    const text = distanceText(from.position, to.position);
    const remove = make("button", {
      textContent: "×",
      title: "Remove this measurement",
      ariaLabel: `Remove the measurement ${text}`,
    });
    remove.addEventListener("click", () => this.remove(measurement));
    measurement.label.append(child("span", text), remove);
    this.labels.append(measurement.label);
    this.measurements.push(measurement);
  }

  private remove(measurement: Measurement): void {
    this.measurements.splice(this.measurements.indexOf(measurement), 1);
    this.root.remove(measurement.root);
    for (const child of measurement.root.children) {
      if (child instanceof THREE.Line) child.geometry.dispose();
    }
    measurement.label.remove();
    this.showHint();
    this.changed();
  }

  /** Whether the first point of a measurement is set, but not the second one. */
  get hasBegun(): boolean {
    return this.begun !== null;
  }

  /** Removes the first point of the next measurement. */
  cancel(): void {
    if (this.begun) this.root.remove(this.begun);
    this.begun = null;
    this.showHint();
    this.changed();
  }

  private keyDown(event: KeyboardEvent): void {
    if (!this.root.visible || event.key !== "Delete" || isKeptByFocus(event) || isPageCovered()) return;
    const last = this.measurements.at(-1);
    if (this.begun) this.cancel();
    else if (last) this.remove(last);
    else return;
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  private showHint(): void {
    const text = this.begun ? SECOND_POINT : this.measurements.length > 0 ? NEXT_POINT : FIRST_POINT;
    this.hint.textContent = inDeviceWords(text);
  }
}

function distanceText(from: THREE.Vector3, to: THREE.Vector3): string {
  const [x, y, z] = to.clone().sub(from).toArray() as [number, number, number];
  return `${lengthText(from.distanceTo(to))} (horizontal ${lengthText(Math.hypot(x, y))}, vertical ${lengthText(Math.abs(z))})`;
}

function lengthText(meters: number): string {
  return meters < 1 ? `${(1000 * meters).toFixed(0)} mm` : `${meters.toFixed(2)} m`;
}
