// A box around the part of the scene to draw or to erase. Handles move its sides, move it, and rotate it.

import * as THREE from "three";
import type { Scene } from "../connection/protocol";
import { type Anchor, type HandlePlace, placeHandles, type Rect } from "./handle_places";
import type { RememberedBox } from "./remembered";
import { type Crop, OrientedBox, type Side } from "./oriented_box";

export type { Crop } from "./oriented_box";

const COLOR = 0xe3b341;
/** Color of the handle that rotates the box. */
const YAW_COLOR = 0x6cb6ff;
/** Opacity of a handle that is not at its place on the box, because this place is out of view. */
const MOVED_OPACITY = 0.6;
/** Radius of a handle, relative to its distance from the viewer. */
const HANDLE_SIZE = 0.011;
/** Distance from a handle within which a press counts, pixels. Fingers are less precise than a mouse. */
const REACH_PX = { mouse: 11, touch: 24 };
/** Length of the sides before the user changes them, relative to the radius of the scene. */
const CROP_SIDE = 1.2;
const EDIT_SIDE = 0.3;
/** Minimum length of the sides, relative to the radius of the scene. */
const MIN_SIDE = 0.02;
/** Rotation if the view is too flat to point at a horizontal plane, radians per pixel. */
const YAW_PER_PX = 0.01;

/** What a handle does. */
type Action = { kind: "side"; side: Side } | { kind: "move" } | { kind: "yaw" };

interface Handle {
  mesh: THREE.Mesh<THREE.SphereGeometry, THREE.MeshBasicMaterial>;
  action: Action;
  /** Where the handle is drawn, pixels of the canvas. */
  place: HandlePlace;
}

/** A handle that is being dragged, and the state at the press. */
interface Drag {
  handle: Handle;
  /** The box at the press. */
  unrotated: THREE.Box3;
  yaw: number;
  /** Where the handle was, and the pointer's ray. */
  origin: THREE.Vector3;
  ray: THREE.Ray;
  x: number;
}

export class CropBox {
  readonly root = new THREE.Group();
  private readonly box = new OrientedBox();
  private readonly edges: THREE.LineSegments;
  private readonly handles: Handle[] = [];
  private radius = 1;
  private dragged: Drag | null = null;
  /** Whether a handle was pressed last, and not the rest of the view. */
  hasTakenPress = false;
  private hasUserChanged = false;
  private sceneCenter = new THREE.Vector3();
  private crops = false;
  private edits = false;
  /** Called when the box has changed, is shown or is hidden. */
  onChange: () => void = () => undefined;

  constructor(
    private readonly camera: THREE.PerspectiveCamera,
    private readonly canvas: HTMLCanvasElement,
    private readonly changed: () => void,
  ) {
    this.root.visible = false;
    const edges = new THREE.EdgesGeometry(new THREE.BoxGeometry(1, 1, 1));
    this.edges = new THREE.LineSegments(edges, new THREE.LineBasicMaterial({ color: COLOR }));
    this.root.add(this.edges);
    const sphere = new THREE.SphereGeometry(1, 16, 12);
    for (const action of actions()) {
      const color = action.kind === "yaw" ? YAW_COLOR : COLOR;
      const material = new THREE.MeshBasicMaterial({ color, depthTest: false, transparent: true });
      const mesh = new THREE.Mesh(sphere, material);
      mesh.renderOrder = 3; // Always visible, so that it can be reached.
      this.handles.push({ mesh, action, place: { x: 0, y: 0, isMoved: false } });
      this.root.add(mesh);
    }
    this.place();
    // This listener is added before the orbit controls, which listen on the same element.
    canvas.addEventListener("pointerdown", (event) => this.begin(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.drag(event), { capture: true });
    for (const kind of ["pointerup", "pointercancel"] as const) {
      canvas.addEventListener(kind, (event) => this.end(event), { capture: true });
    }
  }

  /** Sets whether only the part of the scene in the box is drawn. */
  set enabled(enabled: boolean) {
    this.crops = enabled;
    this.fit();
    this.notify();
  }

  /** Sets whether the box is shown so that its content can be erased. */
  set isEditing(isEditing: boolean) {
    if (isEditing === this.edits) return;
    this.edits = isEditing;
    this.fit();
    this.notify();
  }

  get isVisible(): boolean {
    return this.root.visible;
  }

  /** The box to which the scene is cropped; undefined if it is not cropped. */
  get crop(): Crop | undefined {
    return this.crops ? this.corners : undefined;
  }

  /** The box. */
  get corners(): Crop {
    return this.box.request;
  }

  /** Center and lengths of the sides, meters, and rotation about the vertical axis, radians. */
  get pose(): { center: THREE.Vector3; size: THREE.Vector3; yaw: number } {
    const { center, size, yaw } = this.box;
    return { center, size, yaw };
  }

  /** Changes the box, as the user does. Sides keep a minimum length. */
  setPose(center: THREE.Vector3, size: THREE.Vector3, yaw: number): void {
    this.box.set(center, size.clone().max(new THREE.Vector3().setScalar(this.minSide)), yaw);
    this.userChanged();
  }

  /** Returns to the box that fits the scene. */
  reset(): void {
    this.hasUserChanged = false;
    this.fit();
    this.notify();
  }

  /** The box if the user has changed it; null if it still follows the scene. */
  get changedBox(): RememberedBox | null {
    const { center, size, yaw } = this.box;
    return this.hasUserChanged ? { center: center.toArray(), size: size.toArray(), yaw } : null;
  }

  /** Restores a box that the user has changed earlier. */
  restore({ center, size, yaw }: RememberedBox): void {
    this.setPose(new THREE.Vector3(...center), new THREE.Vector3(...size), yaw);
  }

  /** Sets the relevant part of the scene. */
  setScene(scene: Scene): void {
    this.radius = scene.radius_m;
    this.sceneCenter.set(...scene.center_m);
    this.fit();
    this.onChange();
  }

  /** Shows the box if it is used. Until the user changes it, it encloses the relevant part of the scene, or its center for editing. */
  private fit(): void {
    this.root.visible = this.crops || this.edits;
    if (!this.hasUserChanged) {
      const side = (this.crops ? CROP_SIDE : EDIT_SIDE) * this.radius;
      this.box.set(this.sceneCenter, new THREE.Vector3().setScalar(side), 0);
      this.place();
    }
  }

  /** Places the handles on the screen. */
  update(): void {
    if (!this.root.visible) return;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.camera.updateMatrixWorld();
    const anchors = this.handles.map(({ action }) => this.anchor(this.positionOf(action), width, height));
    const view = { left: 0, top: 0, right: width, bottom: height };
    const places = placeHandles(anchors, view, obstacles(this.canvas));
    for (const [ix, handle] of this.handles.entries()) this.draw(handle, places[ix]!);
  }

  /** Draws a handle at its place on the screen, as far away as its place on the box. */
  private draw(handle: Handle, place: HandlePlace): void {
    const { mesh, action } = handle;
    handle.place = place;
    mesh.position.copy(this.positionOf(action));
    mesh.material.opacity = place.isMoved ? MOVED_OPACITY : 1;
    if (place.isMoved) {
      const distance = Math.max(mesh.position.distanceTo(this.camera.position), 4 * this.camera.near);
      this.rayThrough(place.x, place.y).at(distance, mesh.position);
    }
    mesh.scale.setScalar(HANDLE_SIZE * mesh.position.distanceTo(this.camera.position));
  }

  /** A point of the box on the screen. */
  private anchor(point: THREE.Vector3, width: number, height: number): Anchor {
    const inCamera = point.clone().applyMatrix4(this.camera.matrixWorldInverse);
    if (inCamera.z > -this.camera.near) {
      const toward = new THREE.Vector2(inCamera.x, -inCamera.y).setLength(width + height);
      return { x: 0.5 * width + toward.x, y: 0.5 * height + toward.y, isBehind: true };
    }
    const ndc = point.clone().project(this.camera);
    return { x: 0.5 * (1 + ndc.x) * width, y: 0.5 * (1 - ndc.y) * height, isBehind: false };
  }

  /** The place of a handle on the box, in world. */
  private positionOf(action: Action): THREE.Vector3 {
    if (action.kind === "side") return this.box.sideCenter(action.side);
    return action.kind === "move" ? this.box.center : this.box.edgeCenter;
  }

  private place(): void {
    this.edges.position.copy(this.box.center);
    this.edges.scale.copy(this.box.size);
    this.edges.rotation.z = this.box.yaw;
  }

  private rayThrough(x: number, y: number): THREE.Ray {
    const { clientWidth, clientHeight } = this.canvas;
    const raycaster = new THREE.Raycaster();
    const ndc = new THREE.Vector2((2 * x) / clientWidth - 1, 1 - (2 * y) / clientHeight);
    raycaster.setFromCamera(ndc, this.camera);
    return raycaster.ray;
  }

  private begin(event: PointerEvent): void {
    this.hasTakenPress = false;
    if (!this.root.visible || event.button !== 0) return;
    const reach = event.pointerType === "touch" ? REACH_PX.touch : REACH_PX.mouse;
    const distance = ({ place }: Handle): number => Math.hypot(place.x - event.offsetX, place.y - event.offsetY);
    const [nearest] = this.handles.filter((handle) => distance(handle) < reach).sort((a, b) => distance(a) - distance(b));
    if (!nearest) return;
    this.hasTakenPress = true;
    this.dragged = {
      handle: nearest,
      unrotated: this.box.unrotated.clone(),
      yaw: this.box.yaw,
      origin: nearest.mesh.position.clone(),
      ray: this.rayThrough(event.offsetX, event.offsetY),
      x: event.offsetX,
    };
    event.stopImmediatePropagation();
    this.canvas.setPointerCapture(event.pointerId);
  }

  private drag(event: PointerEvent): void {
    if (!this.dragged) return;
    event.stopImmediatePropagation();
    const { handle, unrotated, yaw } = this.dragged;
    const ray = this.rayThrough(event.offsetX, event.offsetY);
    this.box.unrotated.copy(unrotated);
    this.box.yaw = yaw;
    if (handle.action.kind === "side") this.dragSide(this.dragged, handle.action.side, ray);
    else if (handle.action.kind === "move") this.dragCenter(this.dragged, ray);
    else this.dragYaw(this.dragged, ray, event.offsetX);
    this.userChanged();
  }

  private dragSide({ origin, ray: before }: Drag, side: Side, ray: THREE.Ray): void {
    const outward = this.box.direction(side.axis).multiplyScalar(side.isMax ? 1 : -1);
    const from = closestAlong(origin, outward, before);
    const to = closestAlong(origin, outward, ray);
    if (from !== null && to !== null) this.box.moveSide(side, to - from, this.minSide);
  }

  /** Moves the box parallel to the screen, as far as the pointer at the depth of the box. */
  private dragCenter({ origin, ray: before }: Drag, ray: THREE.Ray): void {
    const forward = this.camera.getWorldDirection(new THREE.Vector3());
    const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(forward, origin);
    const from = before.intersectPlane(plane, new THREE.Vector3());
    const to = ray.intersectPlane(plane, new THREE.Vector3());
    if (from && to) this.box.unrotated.translate(to.sub(from));
  }

  /** Rotates the box about its center, by the angle between the directions to the pointer. */
  private dragYaw({ origin, ray: before, x }: Drag, ray: THREE.Ray, xNow: number): void {
    const { center } = this.box;
    const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(new THREE.Vector3(0, 0, 1), origin);
    const from = before.intersectPlane(plane, new THREE.Vector3())?.sub(center);
    const to = ray.intersectPlane(plane, new THREE.Vector3())?.sub(center);
    const isFlat = Math.abs(before.direction.z) < 0.1;
    const angle =
      from && to && !isFlat ? Math.atan2(to.y, to.x) - Math.atan2(from.y, from.x) : YAW_PER_PX * (xNow - x);
    this.box.yaw += angle;
  }

  private end(event: PointerEvent): void {
    if (!this.dragged) return;
    event.stopImmediatePropagation();
    this.dragged = null;
  }

  private get minSide(): number {
    return MIN_SIDE * this.radius;
  }

  private userChanged(): void {
    this.hasUserChanged = true;
    this.place();
    this.notify();
  }

  private notify(): void {
    this.changed();
    this.onChange();
  }
}

/** The handles: one for each side, one to move the box, and one to rotate it. */
function actions(): Action[] {
  const sides = ([0, 1, 2] as const).flatMap((axis) =>
    [false, true].map((isMax) => ({ kind: "side", side: { axis, isMax } }) as const),
  );
  return [...sides, { kind: "move" }, { kind: "yaw" }];
}

/** The toolbar and the panels over the canvas, in its pixels. */
function obstacles(canvas: HTMLCanvasElement): Rect[] {
  const origin = canvas.getBoundingClientRect();
  const shown = [...(canvas.parentElement?.querySelectorAll(".toolbar, .panel, .bottom > :not(.view-chips), .view-chip") ?? [])];
  return shown
    .map((shape) => shape.getBoundingClientRect())
    .filter(({ width, height }) => width > 0 && height > 0)
    .map(({ left, top, right, bottom }) => ({
      left: left - origin.left,
      top: top - origin.top,
      right: right - origin.left,
      bottom: bottom - origin.top,
    }));
}

/** Position along a line, from its origin, of the point closest to a ray; null if they are parallel. */
function closestAlong(origin: THREE.Vector3, direction: THREE.Vector3, ray: THREE.Ray): number | null {
  const between = ray.origin.clone().sub(origin);
  const cosine = direction.dot(ray.direction);
  const denominator = 1 - cosine * cosine;
  if (denominator < 1e-4) return null;
  return (between.dot(direction) - between.dot(ray.direction) * cosine) / denominator;
}
