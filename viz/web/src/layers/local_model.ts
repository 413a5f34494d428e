// The model that the page draws itself, in the chunks that the server sends.
//
// After another model is chosen or the connection is restored, the present picture stays on screen
// until the new chunks can replace it without holes. The present picture is the server's picture,
// or an older copy of a model.

import * as THREE from "three";
import type { Crop } from "../view/crop_box";
import type { ChunkArrival } from "./chunk_arrival";
import { LocalCopy } from "./local_copy";
import type { ObservationLayer } from "./observation_layer";
import type { ModelChunkHeader, ModelChunksRemoved } from "../connection/protocol";
import type { View } from "../connection/render_scheduler";
import type { SplatEyes } from "./splat_layer";

export class LocalModel {
  readonly root = new THREE.Group();
  private requested: string | null = null;
  /** The copy that is drawn; null if the server's picture is shown. */
  private shown: LocalCopy | null = null;
  /** The copy that will be drawn as soon as it can be. */
  private next: LocalCopy | null = null;
  private shownCrop: Crop | undefined;
  private erasedBoxes: Crop[] = [];

  constructor(
    private readonly observations: ObservationLayer,
    private readonly changed: () => void,
  ) {
    this.root.visible = false;
  }

  /** The model to draw; null if the server draws it. */
  set method(method: string | null) {
    if (method === this.requested) return;
    this.requested = method;
    this.renew();
  }

  get method(): string | null {
    return this.requested;
  }

  /** Whether a copy is drawn instead of the server's picture. */
  get isShown(): boolean {
    return this.shown !== null;
  }

  /** Whether the server's pictures are not needed. */
  get replacesPictures(): boolean {
    const { shown, requested } = this;
    return shown !== null && shown.method === requested && shown.arrival.coversView;
  }

  /** The drawn method, and how much of it has arrived; null if nothing is drawn. */
  get drawn(): { method: string; arrival: ChunkArrival } | null {
    return this.shown;
  }

  /** The method that is being loaded, and how much of it has arrived; null if nothing is loaded. */
  get loading(): { method: string; arrival: ChunkArrival } | null {
    return this.next;
  }

  /** Draws the depth of the splats, see splat_depth.ts; null if that is not possible. */
  drawDepth(renderer: THREE.WebGLRenderer, camera: THREE.Camera, sizePx: [number, number]): THREE.Texture | null {
    return this.shown?.drawDepth(renderer, camera, sizePx) ?? null;
  }

  /** Whether the model is a mesh, which hides what lies behind it. */
  get hasDepth(): boolean {
    return this.shown !== null && this.shown.meshes.root.children.length > 0;
  }

  /** The first surface of the drawn mesh on a ray: its distance and normal. */
  hit(from: THREE.Vector3, direction: THREE.Vector3, maxM: number): { distance: number; normal: THREE.Vector3 } | null {
    return this.root.visible && this.shown ? this.shown.meshes.hit(from, direction, maxM) : null;
  }

  /**
   * Begins a new copy, because a new subscription or connection begins with all chunks. The drawn
   * copy stays until the new copy can replace it.
   */
  renew(): void {
    this.next?.dispose();
    this.next = this.requested === null ? null : new LocalCopy(this.requested, this.observations, this.changed);
    if (this.next) this.next.crop = this.shownCrop;
    this.next?.setErased(this.erasedBoxes);
    this.changed();
  }

  /** Drops the copy of another run. To be called after `renew`. */
  forgetRun(): void {
    // Without a next copy, the present one has already been replaced by that of the new run.
    if (!this.next && this.requested) return;
    this.shown?.dispose();
    this.shown = null;
  }

  /** To be called when the WebGL context is restored. */
  contextRestored(): void {
    this.shown?.contextRestored();
    this.next?.contextRestored();
  }

  /** Adds a chunk or replaces its older version. */
  receive(header: ModelChunkHeader, payload: Uint8Array<ArrayBuffer>): void {
    if (header.method === this.requested) this.receiver?.receive(header, payload);
  }

  removed({ method, ids }: ModelChunksRemoved): void {
    if (method === this.requested) this.receiver?.remove(ids);
  }

  /** To be called when a new picture of the server with colors can be shown. It replaces a copy that is out of date. */
  pictureArrived(): void {
    if (!this.shown || this.replacesPictures) return;
    if (this.shown.method === this.requested && !this.next) {
      this.shown.root.removeFromParent();
      this.next = this.shown; // It has holes in the view of the picture, and is shown again when it has none.
    } else {
      this.shown.dispose();
    }
    this.shown = null;
    this.changed();
  }

  set crop(crop: Crop | undefined) {
    this.shownCrop = crop;
    if (this.shown) this.shown.crop = crop;
    if (this.next) this.next.crop = crop;
  }

  /** Erased boxes. Meshes arrive without the erased triangles, but a box can cut splats. */
  set erased(boxes: Crop[]) {
    this.erasedBoxes = boxes;
    const haveChanged = [this.shown, this.next].map((copy) => copy?.setErased(boxes) ?? false);
    if (haveChanged.some((hasChanged) => hasChanged)) this.changed();
  }

  /**
   * Prepares to draw a view in a buffer of this size, if `root` is visible. Replaces the drawn copy if the next one is
   * ready.
   *
   * `hasPicture` says whether the server's picture shows this view exactly. `eyes` are those of a headset; null for the page.
   */
  setView(view: View, sizePx: [number, number], hasPicture: boolean, eyes: SplatEyes | null = null): void {
    if (!this.root.visible) return;
    const { next } = this;
    if (next?.prepare(this.isReady(next, hasPicture), view, sizePx, eyes)) this.showNext(next);
    this.shown?.setView(view, sizePx, eyes);
  }

  /** Whether a copy can be drawn without holes, and is not worse than the present picture. */
  private isReady(next: LocalCopy, hasPicture: boolean): boolean {
    const { arrival } = next;
    // An older copy of the same model is complete, and hardly differs.
    if (this.shown?.method === next.method) return arrival.hasAll && arrival.completesView;
    // While the view is at rest, the server's picture is better than coarse chunks. It cannot move with the view.
    if (!this.shown && hasPicture) return arrival.completesView;
    return arrival.coversView;
  }

  private showNext(next: LocalCopy): void {
    this.shown?.dispose();
    this.shown = next;
    this.next = null;
    this.root.add(next.root);
    this.changed();
  }

  /** The copy to which new chunks belong. */
  private get receiver(): LocalCopy | null {
    return this.next ?? this.shown;
  }
}
