// Draws Gaussian splats that arrive in chunks.

import * as THREE from "three";
import type { Crop } from "../view/oriented_box";
import type { ObservationLayer } from "./observation_layer";
import type { SplatChunkHeader } from "../connection/protocol";
import { SplatClip } from "./splat_clip";
import { SplatDepth } from "./splat_depth";
import { SplatMemory } from "./splat_memory";
import { SPLAT_FRAGMENT, SPLAT_VERTEX } from "./splat_shader";
import type { FillLens } from "./splat_fill";
import type { FreeUnits, SetChunk, Sort, SortAround, SortResult } from "./splat_sorter";

/** No splat is cut off. */
const WHOLE = 1e9;

/** The eyes of a headset, for which the same splats are drawn in one order. */
export interface SplatEyes {
  /** Pose of the head, in fieldrig's convention. It may contain a scale. */
  worldFromHead: THREE.Matrix4;
  /** The lens of one eye, for the count of covered pixels. */
  lens: FillLens;
  farM: number;
  /** Square of the radius at which splats are cut off, standard deviations. */
  maxReach: number;
  /** Fraction of the splats to draw. */
  share: number;
  /** The head may move by this much before the splats are sorted again, world meters. */
  toleranceM: number;
  /** The lens of an eye in its viewport, pixels, and its pose. */
  eyeOf(camera: THREE.Camera): { worldFromEye: THREE.Matrix4 } & FillLens;
  /** Pixels that the splats cover in one eye, for each of the extents; see splat_fill.ts. */
  onFill(coveredPx: readonly number[], nSplats: number): void;
}

export class SplatLayer {
  readonly mesh: THREE.Mesh<THREE.InstancedBufferGeometry, THREE.RawShaderMaterial>;
  private readonly depth: SplatDepth;
  private readonly memory = new SplatMemory();
  private readonly clip = new SplatClip();
  private readonly units = new Map<number, number[]>();
  private worker: Worker | null = null;
  private isSorting = false;
  private eyes: SplatEyes | null = null;
  /** Where the head was when the newest order was requested, and the fraction of the splats in it. */
  private sortedAround: { headInWorld: THREE.Vector3; share: number } | null = null;
  private readonly worldFromModel = new THREE.Matrix4();
  /** View and version of the splats for which the newest order was requested. */
  private sortedFor = "";
  /** Counts the changes of the splats. */
  private nChanges = 0;
  /** Number of changes at the last requested order, and at the last received order. */
  private nChangesRequested = 0;
  private nChangesSorted = 0;

  constructor(
    observations: ObservationLayer,
    private readonly changed: () => void,
  ) {
    const geometry = new THREE.InstancedBufferGeometry();
    const corners = new Float32Array([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]);
    geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    geometry.instanceCount = 0;
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: SPLAT_VERTEX,
      fragmentShader: SPLAT_FRAGMENT,
      side: THREE.DoubleSide,
      depthTest: false,
      depthWrite: false,
      transparent: true,
      premultipliedAlpha: true,
      blending: THREE.CustomBlending,
      blendSrc: THREE.OneFactor,
      blendDst: THREE.OneMinusSrcAlphaFactor,
      uniforms: {
        base: { value: null },
        harmonics: { value: null },
        units: { value: null },
        cameraFromModel: { value: new THREE.Matrix4() },
        worldFromModel: { value: new THREE.Matrix4() },
        eyeInModel: { value: new THREE.Vector3() },
        sizePx: { value: new THREE.Vector2() },
        focalPx: { value: new THREE.Vector2() },
        principalPx: { value: new THREE.Vector2() },
        depthRange: { value: new THREE.Vector2() },
        maxReach: { value: WHOLE },
        ndcOfDepth: { value: new THREE.Vector2() },
        ...this.clip.uniforms,
        ...observations.uniforms,
      },
    });
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    this.mesh.onBeforeRender = (_renderer, _scene, camera) => this.prepareEye(camera);
    this.depth = new SplatDepth(material);
  }

  /** To be called when the WebGL context is restored. */
  contextRestored(): void {
    this.memory.uploadAgain();
    this.depth.contextRestored();
  }

  /** Adds a chunk or replaces its older version. */
  set(header: SplatChunkHeader, payload: Uint8Array<ArrayBuffer>): void {
    const nWords = 4 * header.n_splats * (header.sh_degree > 0 ? 2 : 1);
    if (payload.length !== 4 * nWords) throw new Error(`splats have ${payload.length} bytes, not ${4 * nWords}`);
    // A copy has the alignment that typed arrays need.
    const words = new Uint32Array(payload.slice().buffer);
    const old = this.units.get(header.id) ?? [];
    const units = this.memory.allocate(header.n_splats, old);
    this.memory.write(units, header, words);
    this.units.set(header.id, units);
    const base = words.slice(0, 4 * header.n_splats);
    const free = old.slice(units.length);
    if (free.length > 0) this.post({ kind: "free", units: free });
    const [minLog, maxLog] = header.log_scale_range;
    const minLogScale = minLog + Math.log(header.scale_factor);
    const logScaleStep = (maxLog - minLog) / 255;
    this.post({ kind: "set", units, words: base, minM: header.min_m, maxM: header.max_m, minLogScale, logScaleStep }, [base.buffer]);
    this.splatsChanged();
  }

  remove(id: number): void {
    const units = this.units.get(id);
    if (!units) return;
    this.memory.free(units);
    this.units.delete(id);
    this.post({ kind: "free", units });
    this.splatsChanged();
  }

  private splatsChanged(): void {
    this.nChanges += 1;
    this.sortedFor = "";
  }

  /** Frees all memory. The layer must not be drawn any more. */
  dispose(): void {
    this.units.clear(); // An order that arrives later is ignored.
    this.worker?.terminate();
    this.memory.dispose();
    this.depth.dispose();
    this.mesh.geometry.dispose();
    this.mesh.material.dispose();
  }

  /** Number of changes of the splats so far, for `isSorted`. */
  get version(): number {
    return this.nChanges;
  }

  /** Whether the splats of a version are sorted, so that they can be drawn. */
  isSorted(version: number): boolean {
    return this.units.size === 0 || this.nChangesSorted >= version;
  }

  /** Draws only the part of the splats in a box. */
  set crop(crop: Crop | undefined) {
    this.clip.setCrop(crop);
    this.selectShaders();
  }

  /** Cuts boxes out of the splats. Returns whether they have changed. */
  setErased(boxes: Crop[]): boolean {
    const hasChanged = this.clip.setErased(boxes);
    this.selectShaders();
    return hasChanged;
  }

  /** Without boxes, the shaders do not even contain the code for them. */
  private selectShaders(): void {
    for (const material of [this.mesh.material, this.depth.material]) {
      material.defines ??= {};
      const { defines } = material;
      if (this.clip.isUsed === "CLIPS" in defines) continue;
      if (this.clip.isUsed) defines.CLIPS = 1;
      else delete defines.CLIPS;
      material.needsUpdate = true;
    }
  }

  /** Prepares to draw from a camera. `worldFromCamera` is in fieldrig's convention. */
  setView(
    worldFromCamera: THREE.Matrix4,
    worldFromModel: THREE.Matrix4,
    [width, height]: [number, number],
    focalPx: [number, number],
    [nearM, farM]: [number, number],
  ): void {
    this.eyes = null;
    this.sortedAround = null;
    if (this.units.size === 0) return;
    this.mesh.material.depthTest = false;
    const { uniforms } = this.mesh.material;
    uniforms.maxReach!.value = WHOLE;
    (uniforms.ndcOfDepth!.value as THREE.Vector2).set(0, 0);
    this.setMemory(worldFromModel);
    const sizePx: [number, number] = [width, height];
    this.setLens(worldFromCamera, { sizePx, focalPx, principalPx: [0.5 * width, 0.5 * height], nearM }, farM);
    this.requestOrder((uniforms.cameraFromModel!.value as THREE.Matrix4).elements);
  }

  /**
   * Prepares to draw for the eyes of a headset. All eyes share one order. Splats have a depth, so that solid bodies and
   * splats hide each other.
   */
  setEyes(eyes: SplatEyes, worldFromModel: THREE.Matrix4): void {
    this.eyes = eyes;
    if (this.units.size === 0) return;
    this.mesh.material.depthTest = true;
    this.mesh.material.uniforms.maxReach!.value = eyes.maxReach;
    this.setMemory(worldFromModel);
    this.requestOrderAround(eyes);
  }

  private setMemory(worldFromModel: THREE.Matrix4): void {
    const { uniforms } = this.mesh.material;
    for (const name of ["base", "harmonics", "units"] as const) uniforms[name]!.value = this.memory[name];
    this.worldFromModel.copy(worldFromModel);
    (uniforms.worldFromModel!.value as THREE.Matrix4).copy(worldFromModel);
  }

  private setLens(worldFromCamera: THREE.Matrix4, { sizePx, focalPx, principalPx, nearM }: FillLens, farM: number): void {
    const { uniforms } = this.mesh.material;
    const modelFromCamera = this.worldFromModel.clone().invert().multiply(worldFromCamera);
    (uniforms.cameraFromModel!.value as THREE.Matrix4).copy(modelFromCamera).invert();
    this.vector3("eyeInModel").setFromMatrixPosition(modelFromCamera);
    (uniforms.sizePx!.value as THREE.Vector2).fromArray(sizePx);
    (uniforms.focalPx!.value as THREE.Vector2).fromArray(focalPx);
    (uniforms.principalPx!.value as THREE.Vector2).fromArray(principalPx);
    (uniforms.depthRange!.value as THREE.Vector2).set(nearM, farM);
  }

  /** Called before the splats are drawn for a camera. */
  private prepareEye(camera: THREE.Camera): void {
    if (!this.eyes || this.units.size === 0) return;
    const { material } = this.mesh;
    const eye = this.eyes.eyeOf(camera);
    this.setLens(eye.worldFromEye, eye, this.eyes.farM);
    const projection = camera.projectionMatrix.elements;
    (material.uniforms.ndcOfDepth!.value as THREE.Vector2).set(projection[10]!, projection[14]!);
    material.uniformsNeedUpdate = true;
  }

  /** Draws the depth of the view, see splat_depth.ts; null if that is not possible. */
  drawDepth(renderer: THREE.WebGLRenderer, camera: THREE.Camera, sizePx: [number, number]): THREE.Texture | null {
    return this.depth.draw(renderer, this.mesh, camera, sizePx);
  }

  /** Sorts the splats unless they are sorted for this view. Sorts once more later if the view changes meanwhile. */
  private requestOrder(cameraFromModel: number[]): void {
    const [x, y, z, offset] = [cameraFromModel[2]!, cameraFromModel[6]!, cameraFromModel[10]!, cameraFromModel[14]!];
    const view = [x, y, z, offset].join();
    if (this.isSorting || view === this.sortedFor) return;
    this.isSorting = true;
    this.sortedFor = view;
    this.nChangesRequested = this.nChanges;
    this.post({ kind: "sort", forward: [x, y, z], offset });
  }

  /** Sorts the splats around the head unless it has hardly moved. */
  private requestOrderAround({ worldFromHead, lens, share, toleranceM }: SplatEyes): void {
    if (this.isSorting) return;
    const headInWorld = new THREE.Vector3().setFromMatrixPosition(worldFromHead);
    const last = this.sortedAround;
    const isSorted = this.nChangesRequested === this.nChanges && last?.share === share;
    if (isSorted && last.headInWorld.distanceTo(headInWorld) <= toleranceM) return;
    this.isSorting = true;
    this.sortedFor = "";
    this.sortedAround = { headInWorld, share };
    this.nChangesRequested = this.nChanges;
    const modelFromHead = this.worldFromModel.clone().invert().multiply(worldFromHead);
    const eye = new THREE.Vector3().setFromMatrixPosition(modelFromHead).toArray();
    const cameraFromModel = modelFromHead.invert().transpose().elements.slice(0, 12);
    this.post({ kind: "sort around", eye, cameraFromModel, lens, share });
  }

  private adopt({ order, coveredPx }: SortResult): void {
    this.isSorting = false;
    if (this.units.size === 0) return; // The order is for splats that are gone.
    if (coveredPx) this.eyes?.onFill(coveredPx, order.length);
    const { geometry } = this.mesh;
    let slots = geometry.getAttribute("slot") as THREE.InstancedBufferAttribute | undefined;
    if (!slots || slots.count < order.length) {
      // A buffer of another size belongs to another attribute.
      geometry.dispose();
      slots = new THREE.InstancedBufferAttribute(new Uint32Array(this.memory.capacity), 1);
      slots.gpuType = THREE.IntType;
      slots.setUsage(THREE.DynamicDrawUsage);
      geometry.setAttribute("slot", slots);
    }
    (slots.array as Uint32Array).set(order);
    slots.clearUpdateRanges();
    slots.addUpdateRange(0, order.length);
    slots.needsUpdate = true;
    geometry.instanceCount = order.length;
    this.nChangesSorted = this.nChangesRequested;
    this.changed();
  }

  private post(message: SetChunk | FreeUnits | Sort | SortAround, transfer: Transferable[] = []): void {
    if (!this.worker) {
      this.worker = new Worker("splat_worker.js");
      this.worker.onmessage = ({ data }: MessageEvent<SortResult>) => this.adopt(data);
    }
    this.worker.postMessage(message, transfer);
  }

  private vector3(name: "eyeInModel"): THREE.Vector3 {
    return this.mesh.material.uniforms[name]!.value as THREE.Vector3;
  }
}
