// A box around the part of the scene to draw or to erase, with a handle on each side.

import * as THREE from "three";
import type { Scene } from "../connection/protocol";

/** The box in a request. */
export interface Crop {
  min_m: [number, number, number];
  max_m: [number, number, number];
}

const COLOR = 0xe3b341;
/** Radius of a handle, relative to its distance from the viewer. */
const HANDLE_SIZE = 0.011;
/** Length of the sides before the user changes them, relative to the radius of the scene. */
const CROP_SIDE = 1.2;
const EDIT_SIDE = 0.3;
/** Minimum length of the sides, relative to the radius of the scene. */
const MIN_SIDE = 0.02;

interface Handle {
  mesh: THREE.Mesh;
  axis: 0 | 1 | 2;
  isMax: boolean;
}

export class CropBox {
  readonly root = new THREE.Group();
  private readonly box = new THREE.Box3(new THREE.Vector3(-1, -1, -1), new THREE.Vector3(1, 1, 1));
  private readonly edges: THREE.LineSegments;
  private readonly handles: Handle[] = [];
  private radius = 1;
  private dragged: Handle | null = null;
  private hasUserChanged = false;
  private center = new THREE.Vector3();
  private crops = false;
  private edits = false;

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
    for (const axis of [0, 1, 2] as const) {
      for (const isMax of [false, true]) {
        const material = new THREE.MeshBasicMaterial({ color: COLOR, depthTest: false, transparent: true });
        const mesh = new THREE.Mesh(sphere, material);
        mesh.renderOrder = 3; // Always visible, so that it can be reached.
        this.handles.push({ mesh, axis, isMax });
        this.root.add(mesh);
      }
    }
    this.place();
    // Before the orbit controls, which listen on the same element.
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
    this.changed();
  }

  /** Sets whether the box is shown so that its content can be erased. */
  set isEditing(isEditing: boolean) {
    if (isEditing === this.edits) return;
    this.edits = isEditing;
    this.fit();
    this.changed();
  }

  /** The box to which the scene is cropped; undefined if it is not cropped. */
  get crop(): Crop | undefined {
    return this.crops ? this.corners : undefined;
  }

  /** The box. */
  get corners(): Crop {
    return { min_m: this.box.min.toArray(), max_m: this.box.max.toArray() };
  }

  /** The box if the user has changed it; null if it still follows the scene. */
  get changedBox(): Crop | null {
    return this.hasUserChanged ? this.corners : null;
  }

  /** Restores a box that the user has changed earlier. */
  restore({ min_m, max_m }: Crop): void {
    this.box.set(new THREE.Vector3(...min_m), new THREE.Vector3(...max_m));
    this.hasUserChanged = true;
    this.place();
    this.changed();
  }

  /** Sets the relevant part of the scene. */
  setScene(scene: Scene): void {
    this.radius = scene.radius_m;
    this.center.set(...scene.center_m);
    this.fit();
  }

  /** Shows the box if it is used. Until the user changes it, it encloses the relevant part of the scene, or its center for editing. */
  private fit(): void {
    this.root.visible = this.crops || this.edits;
    if (!this.hasUserChanged) {
      const side = (this.crops ? CROP_SIDE : EDIT_SIDE) * this.radius;
      this.box.setFromCenterAndSize(this.center, new THREE.Vector3().setScalar(side));
      this.place();
    }
  }

  /** Gives the handles their size on the screen. */
  update(): void {
    if (!this.root.visible) return;
    for (const { mesh } of this.handles) {
      mesh.scale.setScalar(HANDLE_SIZE * mesh.position.distanceTo(this.camera.position));
    }
  }

  private place(): void {
    const center = this.box.getCenter(new THREE.Vector3());
    this.edges.position.copy(center);
    this.edges.scale.copy(this.box.getSize(new THREE.Vector3()));
    for (const { mesh, axis, isMax } of this.handles) {
      mesh.position.copy(center).setComponent(axis, (isMax ? this.box.max : this.box.min).getComponent(axis));
    }
  }

  private ray(event: PointerEvent): THREE.Ray {
    const { clientWidth, clientHeight } = this.canvas;
    const raycaster = new THREE.Raycaster();
    const x = (2 * event.offsetX) / clientWidth - 1;
    raycaster.setFromCamera(new THREE.Vector2(x, 1 - (2 * event.offsetY) / clientHeight), this.camera);
    return raycaster.ray;
  }

  private begin(event: PointerEvent): void {
    if (!this.root.visible || event.button !== 0) return;
    const ray = this.ray(event);
    // Fingers are less precise than the size of the handles.
    const reach = event.pointerType === "touch" ? 3 : 1.6;
    const hits = this.handles.filter(
      ({ mesh }) => ray.distanceToPoint(mesh.position) < reach * mesh.scale.x,
    );
    const distance = ({ mesh }: Handle): number => ray.origin.distanceTo(mesh.position);
    this.dragged = hits.sort((a, b) => distance(a) - distance(b))[0] ?? null;
    if (!this.dragged) return;
    event.stopImmediatePropagation();
    this.canvas.setPointerCapture(event.pointerId);
  }

  private drag(event: PointerEvent): void {
    if (!this.dragged) return;
    event.stopImmediatePropagation();
    const { mesh, axis, isMax } = this.dragged;
    const direction = new THREE.Vector3().setComponent(axis, 1);
    const along = closestAlong(mesh.position, direction, this.ray(event));
    if (along === null) return;
    const value = mesh.position.getComponent(axis) + along;
    const minSide = MIN_SIDE * this.radius;
    if (isMax) this.box.max.setComponent(axis, Math.max(value, this.box.min.getComponent(axis) + minSide));
    else this.box.min.setComponent(axis, Math.min(value, this.box.max.getComponent(axis) - minSide));
    this.hasUserChanged = true;
    this.place();
    this.changed();
  }

  private end(event: PointerEvent): void {
    if (!this.dragged) return;
    event.stopImmediatePropagation();
    this.dragged = null;
  }
}

/** Position along a line, from its origin, of the point closest to a ray; null if they are parallel. */
function closestAlong(origin: THREE.Vector3, direction: THREE.Vector3, ray: THREE.Ray): number | null {
  const between = ray.origin.clone().sub(origin);
  const cosine = direction.dot(ray.direction);
  const denominator = 1 - cosine * cosine;
  if (denominator < 1e-4) return null;
  return (between.dot(direction) - between.dot(ray.direction) * cosine) / denominator;
}
