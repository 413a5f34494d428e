// A copy of a model that the page draws itself, in the chunks of one subscription.

import * as THREE from "three";
import { worldFromCamera } from "../view/convention";
import type { Crop } from "../view/crop_box";
import { ChunkArrival } from "./chunk_arrival";
import { MeshLayer } from "./mesh_layer";
import type { ObservationLayer } from "./observation_layer";
import type { ModelChunkHeader } from "../connection/protocol";
import { type SplatEyes, SplatLayer } from "./splat_layer";
import type { View } from "../connection/render_scheduler";

export class LocalCopy {
  readonly root = new THREE.Group();
  readonly meshes: MeshLayer;
  readonly arrival = new ChunkArrival();
  private readonly splats: SplatLayer;
  private readonly worldFromModel = new THREE.Matrix4();
  /** Chunks are decoded one after the other, so that older ones do not replace newer ones. */
  private decoding: Promise<void> = Promise.resolve();
  private isDisposed = false;
  /** Version of the splats with which the copy became ready; null if the copy is not ready. */
  private readyVersion: number | null = null;

  constructor(
    readonly method: string,
    observations: ObservationLayer,
    private readonly changed: () => void,
  ) {
    this.meshes = new MeshLayer(observations);
    this.splats = new SplatLayer(observations, changed);
    this.root.add(this.meshes.root, this.splats.mesh);
    this.meshes.root.matrixAutoUpdate = false;
  }

  drawDepth(renderer: THREE.WebGLRenderer, camera: THREE.Camera, sizePx: [number, number]): THREE.Texture | null {
    return this.splats.drawDepth(renderer, camera, sizePx);
  }

  /** Frees all memory. The copy must not be drawn any more. */
  dispose(): void {
    this.isDisposed = true;
    this.root.removeFromParent();
    this.meshes.dispose();
    this.splats.dispose();
  }

  /** To be called when the WebGL context is restored. */
  contextRestored(): void {
    this.splats.contextRestored();
  }

  /** Adds a chunk or replaces its older version. */
  receive(header: ModelChunkHeader, payload: Uint8Array<ArrayBuffer>): void {
    this.enqueue(async () => {
      this.worldFromModel.copy(worldFromCamera(header.world_from_model));
      this.meshes.root.matrix.copy(this.worldFromModel);
      this.meshes.root.matrixWorldNeedsUpdate = true;
      if (header.kind === "mesh") await this.meshes.set(header, payload, () => !this.isDisposed);
      else this.splats.set(header, payload);
      this.arrival.add(header);
    });
  }

  remove(ids: number[]): void {
    this.enqueue(async () => {
      for (const id of ids) {
        this.meshes.remove(id);
        this.splats.remove(id);
      }
      this.arrival.remove(ids);
    });
  }

  set crop(crop: Crop | undefined) {
    this.meshes.crop = crop;
    this.splats.crop = crop;
  }

  /** Cuts boxes out of the splats. Returns whether they have changed. */
  setErased(boxes: Crop[]): boolean {
    return this.splats.setErased(boxes);
  }

  /** Prepares to draw a view in a buffer of this size, or for the eyes of a headset. */
  setView(view: View, sizePx: [number, number], eyes: SplatEyes | null): void {
    if (eyes) {
      const head = worldFromCamera(view.world_from_camera);
      this.meshes.setView(head, view.near_m);
      this.splats.setEyes(eyes, this.worldFromModel);
      return;
    }
    const scale = [0, 1].map((axis) => sizePx[axis]! / view.size_px[axis]!);
    const focalPx: [number, number] = [
      view.projection.focal_px[0] * scale[0]!,
      view.projection.focal_px[1] * scale[1]!,
    ];
    const depthRange: [number, number] = [view.near_m, view.far_m];
    const worldFromEye = worldFromCamera(view.world_from_camera);
    this.meshes.setView(worldFromEye, view.near_m);
    this.splats.setView(worldFromEye, this.worldFromModel, sizePx, focalPx, depthRange);
  }

  /**
   * Prepares to draw a copy that is not shown yet, if enough has arrived. Returns whether the copy
   * can be shown. Splats can be drawn only after a worker has sorted them.
   */
  prepare(isReady: boolean, view: View, sizePx: [number, number], eyes: SplatEyes | null): boolean {
    if (!isReady) {
      this.readyVersion = null;
      return false;
    }
    this.readyVersion ??= this.splats.version;
    this.setView(view, sizePx, eyes);
    return this.splats.isSorted(this.readyVersion);
  }

  /** Decodes and changes chunks one after the other. */
  private enqueue(act: () => Promise<void>): void {
    this.decoding = this.decoding
      .then(() => (this.isDisposed ? undefined : act()))
      .catch((error: unknown) => console.error("cannot draw a part of the model:", error))
      .then(this.changed);
  }
}
