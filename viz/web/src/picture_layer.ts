// The newest picture as a surface in the world: a grid of points displaced by the picture's depth.
//
// Viewed from its own pose, the surface reproduces the picture pixel for pixel. Viewed from another pose, while the
// next picture is pending, it moves like the scene. It also fills the depth buffer, so that the model hides lines
// behind it.

import * as THREE from "three";
import { worldFromCamera } from "./convention";
import type { PictureHeader } from "./protocol";

const N_COLUMNS = 256;
const N_ROWS = 144;

const VERTEX = /* glsl */ `
  uniform sampler2D depthMap;
  uniform mat4 worldFromPicture;
  uniform vec2 sizePx;
  uniform vec2 focalPx;
  uniform vec2 principalPx;
  uniform float emptyDepth;
  varying vec3 pointInPicture;
  void main() {
    vec2 uv = position.xy;
    float depth = texture2D(depthMap, uv).r;
    if (!(depth > 0.0)) depth = emptyDepth;
    pointInPicture = vec3((uv * sizePx - principalPx) / focalPx, 1.0) * depth;
    gl_Position = projectionMatrix * viewMatrix * worldFromPicture * vec4(pointInPicture, 1.0);
  }`;

// Colors are looked up by projection, not by the grid's own coordinates, so that the view from the picture's pose is
// exact even where a triangle spans a depth discontinuity.
const FRAGMENT = /* glsl */ `
  uniform sampler2D colorMap;
  uniform vec2 sizePx;
  uniform vec2 focalPx;
  uniform vec2 principalPx;
  varying vec3 pointInPicture;
  void main() {
    vec2 uv = (focalPx * pointInPicture.xy / pointInPicture.z + principalPx) / sizePx;
    gl_FragColor = vec4(texture2D(colorMap, uv).rgb, 1.0);
  }`;

export class PictureLayer {
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.ShaderMaterial>;
  private shown: { id: number; stage: number } | null = null;

  constructor() {
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
      },
      side: THREE.DoubleSide,
      // Lines that lie on a surface must be visible.
      polygonOffset: true,
      polygonOffsetFactor: 1,
      polygonOffsetUnits: 64,
    });
    this.mesh = new THREE.Mesh(gridGeometry(), material);
    this.mesh.frustumCulled = false;
    this.mesh.renderOrder = -1;
    this.mesh.visible = false;
  }

  /** Whether the model hides lines behind it; otherwise lines are always in front. */
  set occludes(occludes: boolean) {
    this.mesh.material.depthWrite = occludes;
  }

  /** Shows a picture unless a newer one is already shown. Returns whether it did. */
  async show(header: PictureHeader, payload: Uint8Array<ArrayBuffer>, emptyDepth: number): Promise<boolean> {
    if (header.projection.kind !== "pinhole" || !header.color) return false;
    const { offset, bytes } = header.color;
    const jpeg = new Blob([payload.subarray(offset, offset + bytes)], { type: "image/jpeg" });
    const bitmap = await createImageBitmap(jpeg, { colorSpaceConversion: "none" });
    if (this.shown && (this.shown.id > header.id || (this.shown.id === header.id && this.shown.stage > header.stage))) {
      bitmap.close();
      return false;
    }
    this.shown = { id: header.id, stage: header.stage };
    const uniforms = this.mesh.material.uniforms as Record<string, THREE.IUniform>;
    replaceTexture(uniforms.colorMap!, colorTexture(bitmap));
    replaceTexture(uniforms.depthMap!, unpackDepth(header, payload));
    uniforms.worldFromPicture!.value = worldFromCamera(header.world_from_camera);
    uniforms.sizePx!.value.fromArray(header.full_size_px);
    uniforms.focalPx!.value.fromArray(header.projection.focal_px);
    uniforms.principalPx!.value.fromArray(header.projection.principal_px);
    uniforms.emptyDepth!.value = emptyDepth;
    this.mesh.visible = true;
    return true;
  }

  /** Resets the numbering, because a new server counts from the start. */
  forget(): void {
    this.shown = null;
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

function unpackDepth(header: PictureHeader, payload: Uint8Array<ArrayBuffer>): THREE.DataTexture {
  const part = header.depth;
  if (!part) return depthTexture(new Float32Array(1), 1, 1);
  // The parts are packed without padding; a copy gives them the alignment that typed arrays need.
  const bytes = payload.slice(part.offset, part.offset + part.bytes).buffer;
  const counts = part.format === "f32" ? new Float32Array(bytes) : new Uint16Array(bytes);
  const depth = Float32Array.from(counts, (count) => count * part.meters_per_count);
  return depthTexture(depth, part.size_px[0], part.size_px[1]);
}

function replaceTexture(slot: THREE.IUniform, texture: THREE.Texture): void {
  const old = slot.value as THREE.Texture | null;
  if (old) {
    (old.image as { close?: () => void }).close?.();
    old.dispose();
  }
  slot.value = texture;
}
