// The newest picture as a surface in the world: a grid of points displaced by the picture's depth.
//
// Viewed from its own pose, the surface reproduces the picture pixel for pixel. Viewed from another pose, while the
// next picture is pending, it moves like the scene. Triangles that span a depth discontinuity are then left out instead
// of being stretched.

import * as THREE from "three";
import { worldFromCamera } from "../view/convention";
import { decodeDepth } from "./depth_part";
import { decodeJpeg } from "./jpeg";
import { type ObservationLayer, TINT } from "./observation_layer";
import type { Occlusion } from "./occlusion";
import type { DepthPart, PictureHeader } from "../connection/protocol";
import type { PosedDepth } from "../view/surface_picker";

/** Saturation of an outdated picture. Its brightness does not change, so that details remain visible. */
const FADED_SATURATION = 0.15;

const N_COLUMNS = 256;
const N_ROWS = 144;

const DEPTH = /* glsl */ `
  uniform sampler2D depthMap; // meters, 0 without a surface
  uniform float emptyDepth;

  float orEmpty(float depth) {
    return depth > 0.0 ? depth : emptyDepth;
  }

  float depthAt(vec2 uv) {
    return orEmpty(texture2D(depthMap, uv).r);
  }`;

const VERTEX = /* glsl */ `${DEPTH}
  uniform mat4 worldFromPicture;
  uniform vec2 sizePx;
  uniform vec2 focalPx;
  uniform vec2 principalPx;
  varying vec3 pointInPicture;
  void main() {
    vec2 uv = position.xy;
    pointInPicture = vec3((uv * sizePx - principalPx) / focalPx, 1.0) * depthAt(uv);
    gl_Position = projectionMatrix * viewMatrix * worldFromPicture * vec4(pointInPicture, 1.0);
  }`;

// Colors are looked up by projection, not by the grid's own coordinates, so that the view from the picture's pose is
// exact even where a triangle spans a depth discontinuity.
const FRAGMENT = /* glsl */ `${TINT}${DEPTH}
  uniform sampler2D colorMap;
  uniform float opacity;
  uniform float saturation;
  uniform bool isMoved;
  uniform bool hidesEmpty;
  uniform vec2 sizePx;
  uniform vec2 focalPx;
  uniform vec2 principalPx;
  uniform mat4 worldFromPicture;
  varying vec3 pointInPicture;

  /**
   * Difference between the depth and the more similar of the neighboring depths, so that
   * discontinuities do not count.
   */
  float depthStep(vec2 uv, float depth, vec2 axis) {
    vec2 stepUv = axis / vec2(textureSize(depthMap, 0));
    return min(abs(depthAt(uv - stepUv) - depth), abs(depthAt(uv + stepUv) - depth));
  }

  /** Maximum difference between the depth of the grid and that of the picture, meters. */
  float tolerance(vec2 uv, float depth) {
    float largest = 0.08 * min(depth, pointInPicture.z);
    vec3 normal = normalize(cross(dFdx(pointInPicture), dFdy(pointInPicture)));
    if (abs(dot(normal, normalize(pointInPicture))) > 0.25) return largest;
    // The triangle is almost parallel to the rays of the picture. Either it spans a discontinuity, or it belongs to a
    // surface seen at a grazing angle, whose depth changes within a pixel.
    float stepPx = sizePx.x / float(textureSize(depthMap, 0).x);
    float depthSteps = depthStep(uv, depth, vec2(1.0, 0.0)) + depthStep(uv, depth, vec2(0.0, 1.0));
    return min(largest, min(0.01 * stepPx * depth, 0.005 * depth + 1.5 * depthSteps));
  }

  void main() {
    vec2 uv = (focalPx * pointInPicture.xy / pointInPicture.z + principalPx) / sizePx;
    float rendered = texture2D(depthMap, uv).r;
    float depth = orEmpty(rendered);
    if (hidesEmpty && !(rendered > 0.0)) discard;
    if (isMoved && abs(pointInPicture.z - depth) > tolerance(uv, depth)) discard;
    vec3 pointInWorld = (worldFromPicture * vec4(pointInPicture * (depth / pointInPicture.z), 1.0)).xyz;
    vec3 color = texture2D(colorMap, uv).rgb;
    // The background keeps its color, so that the edges of the picture do not show.
    vec3 faded = mix(vec3(dot(color, vec3(0.299, 0.587, 0.114))), color, saturation);
    gl_FragColor = vec4(rendered > 0.0 ? tinted(faded, pointInWorld) : color, opacity);
  }`;

/** A picture that has been received, and what becomes of it: whether it is shown. */
interface Received {
  header: PictureHeader;
  payload: Uint8Array<ArrayBuffer>;
  emptyDepth: number;
  resolve: (isShown: boolean) => void;
  reject: (reason: unknown) => void;
}

export class PictureLayer {
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.ShaderMaterial>;
  /** The depth of the shown picture. */
  posedDepth: PosedDepth | null = null;
  /**
   * Whether a picture may be shown. It is called when the picture is decoded, because by then
   * another model may be wanted.
   */
  accepts: (header: PictureHeader) => boolean = () => true;
  private isEnabled = true;
  /** Whether the newest picture has colors. */
  private hasColor = false;
  private shown: { id: number; stage: number } | null = null;
  /** Header of the picture whose colors are shown. */
  private coloredHeader: PictureHeader | null = null;
  private waiting: Received | null = null;
  private isDecoding = false;
  /** Number of servers so far. */
  private nServers = 0;

  constructor(
    private readonly occlusion: Occlusion,
    observations: ObservationLayer,
  ) {
    const material = new THREE.ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: {
        colorMap: { value: null },
        depthMap: { value: depthTexture(new Float32Array(1), 1, 1) },
        worldFromPicture: { value: new THREE.Matrix4() },
        sizePx: { value: new THREE.Vector2() },
        focalPx: { value: new THREE.Vector2() },
        principalPx: { value: new THREE.Vector2() },
        emptyDepth: { value: 1 },
        isMoved: { value: false },
        hidesEmpty: { value: false },
        opacity: { value: 1 },
        saturation: { value: 1 },
        ...observations.uniforms,
      },
      transparent: true,
      side: THREE.DoubleSide,
    });
    this.mesh = new THREE.Mesh(gridGeometry(), material);
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
  }

  /** Whether the picture is drawn. */
  set enabled(enabled: boolean) {
    this.isEnabled = enabled;
    this.mesh.visible = enabled && this.hasColor;
  }

  /** Header of the picture whose colors are shown; null if there is none. */
  get header(): PictureHeader | null {
    return this.hasColor ? this.coloredHeader : null;
  }

  /** Removes most of the colors of a picture that is not the wanted one. Returns whether this is a change. */
  setFaded(isFaded: boolean): boolean {
    const { saturation } = this.mesh.material.uniforms as Record<string, THREE.IUniform>;
    const value = isFaded ? FADED_SATURATION : 1;
    const isChange = saturation!.value !== value;
    saturation!.value = value;
    return isChange;
  }

  /** Whether pixels without a model are left out, so that the real room is visible there. */
  set hidesEmpty(hidesEmpty: boolean) {
    this.mesh.material.uniforms.hidesEmpty!.value = hidesEmpty;
  }

  /** Opacity of the picture, 0 to 1. */
  set opacity(opacity: number) {
    this.mesh.material.uniforms.opacity!.value = opacity;
  }

  /** Sets the pose of the view, in fieldrig's convention. */
  setView(worldFromView: THREE.Matrix4): void {
    const uniforms = this.mesh.material.uniforms as Record<string, THREE.IUniform>;
    const picture = (uniforms.worldFromPicture!.value as THREE.Matrix4).elements;
    uniforms.isMoved!.value = worldFromView.elements.some((value, ix) => Math.abs(value - picture[ix]!) > 1e-4);
  }

  /** Whether the picture shows exactly the view of the last `setView`. */
  get showsView(): boolean {
    return this.hasColor && this.mesh.material.uniforms.isMoved!.value === false;
  }

  /**
   * Shows a picture, unless a newer picture arrives before it is decoded. Returns whether the
   * picture was shown. A picture may consist of depth only.
   */
  show(header: PictureHeader, payload: Uint8Array<ArrayBuffer>, emptyDepth: number): Promise<boolean> {
    return new Promise((resolve, reject) => {
      this.waiting?.resolve(false);
      this.waiting = { header, payload, emptyDepth, resolve, reject };
      if (!this.isDecoding) void this.decodeWaiting();
    });
  }

  private async decodeWaiting(): Promise<void> {
    this.isDecoding = true;
    for (let next = this.waiting; next; next = this.waiting) {
      this.waiting = null;
      await this.decode(next.header, next.payload, next.emptyDepth).then(next.resolve, next.reject);
    }
    this.isDecoding = false;
  }

  private async decode(
    header: PictureHeader,
    payload: Uint8Array<ArrayBuffer>,
    emptyDepth: number,
  ): Promise<boolean> {
    if (header.projection.kind !== "pinhole") return false;
    const server = this.nServers;
    const [bitmap, depth] = await Promise.all([
      header.color ? decodeJpeg(payload, header.color, { colorSpaceConversion: "none" }) : null,
      unpackDepth(header.depth, payload),
    ]);
    const isOlder =
      this.shown &&
      (this.shown.id > header.id || (this.shown.id === header.id && this.shown.stage > header.stage));
    if (isOlder || server !== this.nServers || !this.accepts(header)) {
      bitmap?.close();
      return false;
    }
    this.shown = { id: header.id, stage: header.stage };
    const uniforms = this.mesh.material.uniforms as Record<string, THREE.IUniform>;
    this.hasColor = bitmap !== null;
    if (bitmap) {
      replaceTexture(uniforms.colorMap!, colorTexture(bitmap));
      this.coloredHeader = header;
    }
    replaceTexture(uniforms.depthMap!, depth);
    const worldFromPicture = worldFromCamera(header.world_from_camera);
    uniforms.worldFromPicture!.value = worldFromPicture;
    uniforms.sizePx!.value.fromArray(header.full_size_px);
    uniforms.focalPx!.value.fromArray(header.projection.focal_px);
    uniforms.principalPx!.value.fromArray(header.projection.principal_px);
    uniforms.emptyDepth!.value = emptyDepth;
    const camera = {
      worldFromPicture,
      sizePx: header.full_size_px,
      focalPx: header.projection.focal_px,
      principalPx: header.projection.principal_px,
    };
    this.occlusion.picture = { texture: depth, isWeighted: false, ...camera };
    const { data, width, height } = depth.image as { data: Float32Array; width: number; height: number };
    this.posedDepth = { ...camera, depth: data, depthSizePx: [width, height] };
    this.enabled = this.isEnabled;
    return true;
  }

  /** Resets the numbering, because a new server counts from the start. Pictures of the old server are not shown. */
  forget(): void {
    this.nServers += 1;
    this.waiting?.resolve(false);
    this.waiting = null;
    this.shown = null;
  }

  /** Removes the picture, because it belongs to another run. */
  remove(): void {
    this.forget();
    this.hasColor = false;
    this.mesh.visible = false;
    this.posedDepth = null;
  }
}

/** Points from (0, 0) at the picture's top left to (1, 1) at its bottom right. */
function gridGeometry(): THREE.BufferGeometry {
  const geometry = new THREE.PlaneGeometry(1, 1, N_COLUMNS, N_ROWS);
  geometry.translate(0.5, 0.5, 0);
  return geometry;
}

function colorTexture(bitmap: ImageBitmap): THREE.Texture {
  const texture = new THREE.Texture(bitmap);
  texture.flipY = false;
  texture.generateMipmaps = false;
  texture.minFilter = THREE.LinearFilter;
  texture.magFilter = THREE.LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

function depthTexture(depth: Float32Array<ArrayBuffer>, width: number, height: number): THREE.DataTexture {
  const texture = new THREE.DataTexture(depth, width, height, THREE.RedFormat, THREE.FloatType);
  texture.needsUpdate = true;
  return texture;
}

async function unpackDepth(
  part: DepthPart | null,
  payload: Uint8Array<ArrayBuffer>,
): Promise<THREE.DataTexture> {
  if (!part) return depthTexture(new Float32Array(1), 1, 1);
  const { depth, sizePx } = await decodeDepth(part, payload);
  return depthTexture(depth, ...sizePx);
}

function replaceTexture(slot: THREE.IUniform, texture: THREE.Texture): void {
  const old = slot.value as THREE.Texture | null;
  if (old) {
    (old.image as { close?: () => void }).close?.();
    old.dispose();
  }
  slot.value = texture;
}
