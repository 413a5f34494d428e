// The gizmo at the hand: three arrows, three rings, and a ball. It takes presses before the view does.

import * as THREE from "three";
import type { ViewTool } from "../view/view_tool";
import { ARROW, Drag, type Handle, HANDLES, nearestOutline, outline, RING_RADIUS, type ScreenPoint } from "./gizmo_drag";
import { composed, inverse, type Pose } from "./pose";

/** Length of the arrows on the screen, pixels. */
const SIZE_PX = 96;
/** Distance from a handle within which a press counts, pixels. Fingers are less precise than a mouse. */
const REACH_PX = { mouse: 10, touch: 22 };
/** Colors of x, y and z, as everywhere in the view; the ball is white. */
const COLORS = [0xf0716a, 0x7bd88f, 0x6cb6ff];
const BALL_COLOR = 0xdbe2ea;
const HELD_COLOR = 0xffffff;
const THICKNESS = 0.025;

export interface GizmoEvents {
  /** A handle is pressed. Returns whether it can be dragged. */
  begin(): boolean;
  /** The pose to which the pointer drags the hand, in the base. */
  drag(baseFromHand: Pose): void;
  end(): void;
}

interface Part {
  handle: Handle;
  outline: THREE.Vector3[];
  object: THREE.Group;
  material: THREE.MeshBasicMaterial;
  color: number;
}

interface Grab {
  pointerId: number;
  part: Part;
  drag: Drag;
  /** Camera and base at the press. They are kept, so that neither a moving view nor a corrected map moves the hand. */
  camera: THREE.PerspectiveCamera;
  baseFromWorld: Pose;
}

export class Gizmo implements ViewTool {
  readonly root = new THREE.Group();
  hasTakenPress = false;
  private readonly parts: Part[];
  private pose: { worldFromBase: Pose; baseFromHand: Pose; worldFromAxes: THREE.Quaternion } | null = null;
  /** The last pose as text: the view is drawn again only if it changes. */
  private placed = "";
  private grab: Grab | null = null;

  constructor(
    private readonly camera: THREE.PerspectiveCamera,
    private readonly canvas: HTMLCanvasElement,
    private readonly events: GizmoEvents,
    private readonly changed: () => void,
  ) {
    this.root.visible = false;
    this.parts = HANDLES.map(partOf);
    this.root.add(...this.parts.map(({ object }) => object));
    // The parent gets the events before the canvas, whose listeners would move the view.
    const view = canvas.parentElement!;
    const capture = { capture: true };
    view.addEventListener("pointerdown", (event) => this.press(event), capture);
    view.addEventListener("pointermove", (event) => this.move(event), capture);
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"] as const) {
      view.addEventListener(kind, (event) => this.release(event), capture);
    }
  }

  /** Places the gizmo; null hides it. While it is dragged, its axes stay. */
  place(pose: Gizmo["pose"]): void {
    const key = pose ? JSON.stringify(pose) : "";
    if (key === this.placed) return;
    this.placed = key;
    const axes = this.grab ? this.pose?.worldFromAxes : undefined;
    this.pose = pose && { ...pose, worldFromAxes: axes ?? pose.worldFromAxes };
    this.root.visible = pose !== null;
    if (!pose) this.giveUp();
    this.changed();
  }

  /** Ends a drag without the pointer's release. */
  giveUp(): void {
    if (!this.grab) return;
    this.grab = null;
    this.colorParts();
    this.events.end();
  }

  update(): void {
    if (!this.pose) return;
    const { position } = composed(this.pose.worldFromBase, this.pose.baseFromHand);
    this.root.position.copy(position);
    this.root.quaternion.copy(this.pose.worldFromAxes);
    const depth = Math.max(-position.clone().applyMatrix4(this.camera.matrixWorldInverse).z, this.camera.near);
    const heightM = 2 * depth * Math.tan(THREE.MathUtils.degToRad(0.5 * this.camera.fov));
    this.root.scale.setScalar((SIZE_PX / Math.max(1, this.canvas.clientHeight)) * heightM);
    this.root.updateMatrixWorld(true);
  }

  private press(event: PointerEvent): void {
    if (event.target !== this.canvas) return;
    this.hasTakenPress = false;
    if (!this.pose || this.grab || event.button !== 0) return;
    this.camera.updateMatrixWorld();
    this.update();
    const reach = event.pointerType === "touch" ? REACH_PX.touch : REACH_PX.mouse;
    const ix = nearestOutline(this.parts.map((part) => this.onScreen(part)), { x: event.offsetX, y: event.offsetY }, reach);
    const part = this.parts[ix];
    if (!part) return;
    this.hasTakenPress = true;
    event.stopPropagation();
    event.preventDefault();
    // First, because it fails if the pointer is gone: then, the hand must not be held.
    this.canvas.setPointerCapture(event.pointerId);
    if (!this.events.begin()) {
      this.canvas.releasePointerCapture(event.pointerId);
      return;
    }
    const camera = this.camera.clone();
    camera.updateMatrixWorld(true);
    const { worldFromBase, baseFromHand, worldFromAxes } = this.pose;
    const start = composed(worldFromBase, baseFromHand);
    const forward = camera.getWorldDirection(new THREE.Vector3());
    const drag = new Drag(part.handle, start, worldFromAxes, forward, this.ray(camera, event));
    this.grab = { pointerId: event.pointerId, part, drag, camera, baseFromWorld: inverse(worldFromBase) };
    this.colorParts();
  }

  private move(event: PointerEvent): void {
    const { grab } = this;
    if (!grab || event.pointerId !== grab.pointerId) return;
    event.stopPropagation();
    // The release of one of several buttons is a move.
    if (event.pointerType === "mouse" && (event.buttons & 1) === 0) {
      this.giveUp();
      return;
    }
    const worldFromHand = grab.drag.to(this.ray(grab.camera, event));
    this.events.drag(composed(grab.baseFromWorld, worldFromHand));
  }

  private release(event: PointerEvent): void {
    if (!this.grab || event.pointerId !== this.grab.pointerId) return;
    event.stopPropagation();
    this.giveUp();
  }

  private ray(camera: THREE.PerspectiveCamera, { offsetX, offsetY }: PointerEvent): THREE.Ray {
    const raycaster = new THREE.Raycaster();
    const { clientWidth, clientHeight } = this.canvas;
    raycaster.setFromCamera(new THREE.Vector2((2 * offsetX) / clientWidth - 1, 1 - (2 * offsetY) / clientHeight), camera);
    return raycaster.ray;
  }

  private onScreen({ outline: points }: Part): ScreenPoint[] {
    const { clientWidth, clientHeight } = this.canvas;
    const projected = points.map((point) => point.clone().applyMatrix4(this.root.matrixWorld).project(this.camera));
    // Beyond the near and far planes, there is nothing to press.
    if (projected.some(({ z }) => Math.abs(z) > 1)) return [];
    return projected.map(({ x, y }) => ({ x: 0.5 * (1 + x) * clientWidth, y: 0.5 * (1 - y) * clientHeight }));
  }

  private colorParts(): void {
    for (const part of this.parts) part.material.color.setHex(part === this.grab?.part ? HELD_COLOR : part.color);
    this.changed();
  }
}

function partOf(handle: Handle): Part {
  const color = handle.kind === "plane" ? BALL_COLOR : COLORS[handle.axis]!;
  const material = new THREE.MeshBasicMaterial({ color, depthTest: false, transparent: true, opacity: 0.9 });
  const object = new THREE.Group();
  for (const geometry of geometries(handle)) {
    const mesh = new THREE.Mesh(geometry, material);
    mesh.renderOrder = 4; // Always visible, so that it can be reached.
    object.add(mesh);
  }
  if (handle.kind !== "plane") {
    // The geometries are along z.
    const axis = new THREE.Vector3().setComponent(handle.axis, 1);
    object.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), axis);
  }
  return { handle, outline: outline(handle), object, material, color };
}

function geometries({ kind }: Handle): THREE.BufferGeometry[] {
  if (kind === "plane") return [new THREE.SphereGeometry(0.09, 16, 12)];
  if (kind === "turn") return [new THREE.TorusGeometry(RING_RADIUS, THICKNESS * 0.7, 8, 64)];
  const [shaftM, tipM] = [ARROW.end - ARROW.begin - 0.2, 0.2];
  const shaft = new THREE.CylinderGeometry(THICKNESS, THICKNESS, shaftM, 10).rotateX(Math.PI / 2);
  const tip = new THREE.CylinderGeometry(0, 3 * THICKNESS, tipM, 14).rotateX(Math.PI / 2);
  return [shaft.translate(0, 0, ARROW.begin + 0.5 * shaftM), tip.translate(0, 0, ARROW.end - 0.5 * tipM)];
}
