// The arrow that shows the goal of a base. While a place is being chosen, a press on the view places it, and a drag turns it.

import * as THREE from "three";
import type { ViewTool } from "../view/view_tool";
import { draggedGoal, type Place } from "./floor_goal";
import type { Point } from "./messages";

/** Size of the arrow, meters: about that of a small base. */
const LENGTH_M = 0.6;
const RADIUS_M = 0.03;
const COLOR = 0xffc857;

export class FloorGoalTool implements ViewTool {
  readonly root = new THREE.Group();
  hasTakenPress = false;
  /** Whether a press on the view chooses a place. */
  isChoosing = false;
  private shown = "";
  private grab: { pointerId: number; from: Place } | null = null;
  /** Height of the base link, meters, and its heading. */
  private base = { z: 0, heading: 0 };

  /** `chosen` is called for each place and heading; `ended` at the end of the drag. */
  constructor(
    private readonly camera: THREE.PerspectiveCamera,
    private readonly canvas: HTMLCanvasElement,
    private readonly chosen: (goal: Point) => void,
    private readonly ended: () => void,
    private readonly changed: () => void,
  ) {
    this.root.visible = false;
    const material = new THREE.MeshBasicMaterial({ color: COLOR, depthTest: false, transparent: true, opacity: 0.9 });
    const tipM = 0.3 * LENGTH_M;
    const shaft = new THREE.CylinderGeometry(RADIUS_M, RADIUS_M, LENGTH_M - tipM, 10);
    const tip = new THREE.CylinderGeometry(0, 3 * RADIUS_M, tipM, 14);
    for (const [geometry, at] of [[shaft, 0.5 * (LENGTH_M - tipM)], [tip, LENGTH_M - 0.5 * tipM]] as const) {
      // Cylinders are along y, and the arrow is along x.
      const mesh = new THREE.Mesh(geometry.rotateZ(-Math.PI / 2).translate(at, 0, 0), material);
      mesh.renderOrder = 4; // Always visible, also below the floor of the model.
      this.root.add(mesh);
    }
    // The parent gets the events before the canvas, whose listeners would move the view.
    const view = canvas.parentElement!;
    const capture = { capture: true };
    view.addEventListener("pointerdown", (event) => this.press(event), capture);
    view.addEventListener("pointermove", (event) => this.move(event), capture);
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"] as const) {
      view.addEventListener(kind, (event) => this.release(event), capture);
    }
  }

  /** Shows a goal at the height of the base link; null hides it. */
  show(goal: Point | null, base: { z: number; heading: number }): void {
    this.base = base;
    const key = goal ? [...goal, base.z].join() : "";
    if (key === this.shown) return;
    this.shown = key;
    this.root.visible = goal !== null;
    if (goal) {
      this.root.position.set(goal[0], goal[1], base.z);
      this.root.rotation.set(0, 0, goal[2]);
    }
    this.changed();
  }

  update(): void {
    this.root.updateMatrixWorld(true);
  }

  private press(event: PointerEvent): void {
    if (event.target !== this.canvas) return;
    this.hasTakenPress = false;
    const from = this.isChoosing && event.button === 0 && !this.grab ? this.onFloor(event) : null;
    if (!from) return;
    this.hasTakenPress = true;
    event.stopPropagation();
    event.preventDefault();
    this.canvas.setPointerCapture(event.pointerId);
    this.grab = { pointerId: event.pointerId, from };
    this.chosen(draggedGoal(from, from, this.base.heading));
  }

  private move(event: PointerEvent): void {
    if (!this.grab || event.pointerId !== this.grab.pointerId) return;
    event.stopPropagation();
    const to = this.onFloor(event);
    if (to) this.chosen(draggedGoal(this.grab.from, to, this.base.heading));
  }

  private release(event: PointerEvent): void {
    if (!this.grab || event.pointerId !== this.grab.pointerId) return;
    event.stopPropagation();
    this.grab = null;
    this.ended();
  }

  /** The place under the pointer at the height of the base link; null above the horizon. */
  private onFloor({ offsetX, offsetY }: PointerEvent): Place | null {
    const { clientWidth, clientHeight } = this.canvas;
    this.camera.updateMatrixWorld();
    const raycaster = new THREE.Raycaster();
    raycaster.setFromCamera(new THREE.Vector2((2 * offsetX) / clientWidth - 1, 1 - (2 * offsetY) / clientHeight), this.camera);
    const plane = new THREE.Plane(new THREE.Vector3(0, 0, 1), -this.base.z);
    const point = raycaster.ray.intersectPlane(plane, new THREE.Vector3());
    return point && [point.x, point.y];
  }
}
