// The model that the page draws itself, in the chunks that the server sends.

import * as THREE from "three";
import { worldFromCamera } from "../view/convention";
import type { Crop } from "../view/crop_box";
import { MeshLayer } from "./mesh_layer";
import type { ObservationLayer } from "./observation_layer";
import type { ModelChunkHeader, ModelChunksRemoved } from "../connection/protocol";
import { SplatLayer } from "./splat_layer";
import type { View } from "../connection/render_scheduler";

export class LocalModel {
  readonly root = new THREE.Group();
  /** Number of chunks of the model, and of those that are missing or coarse. */
  progress = { nChunks: 0, nIncomplete: 0 };
  private readonly meshes: MeshLayer;
  private readonly splats: SplatLayer;
  private readonly worldFromModel = new THREE.Matrix4();
  private drawn: string | null = null;
  /** Chunks are decoded one after the other, so that older ones do not replace newer ones. */
  private decoding: Promise<void> = Promise.resolve();
  /** Counts the resets; chunks from before are dropped. */
  private generation = 0;

  constructor(
    observations: ObservationLayer,
    private readonly changed: () => void,
  ) {
    this.meshes = new MeshLayer(observations);
    this.splats = new SplatLayer(observations, changed);
    this.root.add(this.meshes.root, this.splats.mesh);
    this.meshes.root.matrixAutoUpdate = false;
    this.root.visible = false;
  }

  /** The model to draw; null if the server draws it. */
  set method(method: string | null) {
    if (method === this.drawn) return;
    this.drawn = method;
    this.clear();
  }

  get method(): string | null {
    return this.drawn;
  }

  /** Whether there is anything to draw. */
  get hasChunks(): boolean {
    return this.progress.nChunks > 0;
  }

  /** Draws the depth of the splats, see splat_depth.ts; null if that is not possible. */
  drawDepth(renderer: THREE.WebGLRenderer, camera: THREE.Camera, sizePx: [number, number]): THREE.Texture | null {
    return this.splats.drawDepth(renderer, camera, sizePx);
  }

  /** Whether the model is a mesh, which hides what lies behind it. */
  get hasDepth(): boolean {
    return this.meshes.root.children.length > 0;
  }

  /** The first surface of the drawn mesh on a ray: its distance and normal. */
  hit(from: THREE.Vector3, direction: THREE.Vector3, maxM: number): { distance: number; normal: THREE.Vector3 } | null {
    return this.root.visible ? this.meshes.hit(from, direction, maxM) : null;
  }

  /** Drops all chunks. The server sends them again after a new subscription. */
  clear(): void {
    this.generation += 1;
    this.progress = { nChunks: 0, nIncomplete: 0 };
    this.meshes.clear();
    this.splats.clear();
    this.changed();
  }

  /** To be called when the WebGL context is restored. */
  contextRestored(): void {
    this.splats.contextRestored();
  }

  /** Adds a chunk or replaces its older version. */
  receive(header: ModelChunkHeader, payload: Uint8Array<ArrayBuffer>): void {
    if (header.method !== this.drawn) return;
    this.progress = { nChunks: header.n_chunks, nIncomplete: header.n_incomplete };
    this.worldFromModel.copy(worldFromCamera(header.world_from_model));
    this.meshes.root.matrix.copy(this.worldFromModel);
    this.meshes.root.matrixWorldNeedsUpdate = true;
    this.enqueue(async (isCurrent) => {
      if (header.kind === "mesh") await this.meshes.set(header, payload, isCurrent);
      else this.splats.set(header, payload);
    });
  }

  removed({ method, ids }: ModelChunksRemoved): void {
    if (method !== this.drawn) return;
    this.enqueue(async () => {
      for (const id of ids) {
        this.meshes.remove(id);
        this.splats.remove(id);
      }
    });
  }

  set crop(crop: Crop | undefined) {
    this.meshes.crop = crop;
    this.splats.crop = crop;
  }

  /** Prepares to draw a view in a buffer of this size. */
  setView(view: View, sizePx: [number, number]): void {
    if (!this.root.visible) return;
    const scale = [0, 1].map((axis) => sizePx[axis]! / view.size_px[axis]!);
    const focalPx: [number, number] = [
      view.projection.focal_px[0] * scale[0]!,
      view.projection.focal_px[1] * scale[1]!,
    ];
    const depthRange: [number, number] = [view.near_m, view.far_m];
    this.meshes.setView(worldFromCamera(view.world_from_camera), view.near_m);
    this.splats.setView(worldFromCamera(view.world_from_camera), this.worldFromModel, sizePx, focalPx, depthRange);
  }

  /** Decodes and changes chunks one after the other. */
  private enqueue(act: (isCurrent: () => boolean) => Promise<void>): void {
    const { generation } = this;
    const isCurrent = (): boolean => generation === this.generation;
    this.decoding = this.decoding
      .then(() => (isCurrent() ? act(isCurrent) : undefined))
      .catch((error: unknown) => console.error("cannot draw a part of the model:", error))
      .then(this.changed);
  }
}
