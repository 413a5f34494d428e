// A picture of the server with its depth, drawn as a surface: at its place in the world for one eye, or as a relief on a panel
// in the hand. From the pose of the picture, it reproduces the picture exactly, and its depth is that of the server, so that it
// and solid bodies hide each other pixel by pixel.

import * as THREE from "three";
import type { PictureHeader } from "../connection/protocol";
import { decodeDepth } from "../layers/depth_part";
import { decodeJpeg } from "../layers/jpeg";
import { worldFromCamera } from "../view/convention";

const N_CELLS = 160;
/** Relative steps of depth beyond which a triangle spans two surfaces. */
const MAX_STEP = 0.06;
/** Depth of the relief behind the panel, and distance of the eye from which it looks like the picture, meters. */
const RELIEF_M = 0.05;
const RELIEF_EYE_M = 0.5;

const LOOKUP = /* glsl */ `
  uniform sampler2D depthMap; // meters, 0 without a surface
  uniform float emptyDepth;
  uniform vec2 sizePx;
  uniform vec2 focalPx;
  uniform vec2 principalPx;
  float depthAt(vec2 uv) {
    float depth = texture2D(depthMap, uv).r;
    return depth > 0.0 ? depth : emptyDepth;
  }`;

const IN_WORLD_VERTEX = /* glsl */ `${LOOKUP}
  uniform mat4 worldFromPicture;
  varying vec3 pointInPicture;
  varying vec2 projectionZ;
  void main() {
    vec2 uv = position.xy;
    pointInPicture = vec3((uv * sizePx - principalPx) / focalPx, 1.0) * depthAt(uv);
    projectionZ = vec2(projectionMatrix[2][2], projectionMatrix[3][2]);
    gl_Position = projectionMatrix * viewMatrix * worldFromPicture * vec4(pointInPicture, 1.0);
  }`;

// Colors are looked up by projection and not by the grid's own coordinates, as in layers/picture_layer.ts.
const IN_WORLD_FRAGMENT = /* glsl */ `${LOOKUP}
  uniform sampler2D colorMap;
  uniform mat4 worldFromPicture;
  uniform bool hidesEmpty;
  varying vec3 pointInPicture;
  varying vec2 projectionZ;
  void main() {
    vec2 uv = (focalPx * pointInPicture.xy / pointInPicture.z + principalPx) / sizePx;
    float rendered = texture2D(depthMap, uv).r;
    if (hidesEmpty && !(rendered > 0.0)) discard;
    float depth = depthAt(uv);
    if (abs(pointInPicture.z - depth) > ${MAX_STEP} * min(depth, pointInPicture.z)) {
      // Seen from the pose of the picture, the other surface is right behind this pixel.
      vec3 exact = pointInPicture * (depth / pointInPicture.z);
      vec4 a = viewMatrix * worldFromPicture * vec4(exact, 1.0);
      vec4 b = viewMatrix * worldFromPicture * vec4(pointInPicture, 1.0);
      vec2 shift = (a.xy / a.z - b.xy / b.z) * focalPx;
      if (dot(shift, shift) > 2.0) discard;
    }
    float z = (viewMatrix * worldFromPicture * vec4(pointInPicture * (depth / pointInPicture.z), 1.0)).z;
    gl_FragDepth = 0.5 * (projectionZ.x * z + projectionZ.y) / -z + 0.5;
    gl_FragColor = vec4(texture2D(colorMap, uv).rgb, 1.0);
  }`;

const RELIEF_VERTEX = /* glsl */ `${LOOKUP}
  uniform float nearestM;
  varying vec2 pictureUv;
  void main() {
    pictureUv = position.xy;
    float behind = ${RELIEF_M} * (1.0 - nearestM / max(nearestM, depthAt(pictureUv)));
    float spread = 1.0 + behind / ${RELIEF_EYE_M};
    vec3 onPanel = vec3((pictureUv.x - 0.5) * spread, (0.5 - pictureUv.y) * spread * sizePx.y / sizePx.x, 0.0);
    vec4 inEye = modelViewMatrix * vec4(onPanel, 1.0) + viewMatrix * modelMatrix * vec4(0.0, 0.0, -behind, 0.0);
    gl_Position = projectionMatrix * inEye;
  }`;

const RELIEF_FRAGMENT = /* glsl */ `
  uniform sampler2D colorMap;
  varying vec2 pictureUv;
  void main() {
    gl_FragColor = vec4(texture2D(colorMap, pictureUv).rgb, 1.0);
  }`;

export class DepthPicture {
  readonly mesh: THREE.Mesh<THREE.PlaneGeometry, THREE.ShaderMaterial>;
  /** Counts the pictures, so that an older one that is decoded late does not replace a newer one. */
  private nReceived = 0;
  private nShown = 0;
  private isDisposed = false;

  constructor(kind: "in world" | "relief") {
    const isRelief = kind === "relief";
    const material = new THREE.ShaderMaterial({
      vertexShader: isRelief ? RELIEF_VERTEX : IN_WORLD_VERTEX,
      fragmentShader: isRelief ? RELIEF_FRAGMENT : IN_WORLD_FRAGMENT,
      uniforms: {
        colorMap: { value: null },
        depthMap: { value: null },
        worldFromPicture: { value: new THREE.Matrix4() },
        sizePx: { value: new THREE.Vector2(1, 1) },
        focalPx: { value: new THREE.Vector2(1, 1) },
        principalPx: { value: new THREE.Vector2() },
        emptyDepth: { value: 1 },
        nearestM: { value: 1 },
        hidesEmpty: { value: false },
      },
      side: THREE.DoubleSide,
    });
    const geometry = new THREE.PlaneGeometry(1, 1, N_CELLS, N_CELLS).translate(0.5, 0.5, 0);
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
  }

  /** Whether a picture has arrived. */
  get hasPicture(): boolean {
    return this.nShown > 0;
  }

  /** Shows a picture. Pixels without a surface are placed at `emptyDepth`, or left out. */
  async show(header: PictureHeader, payload: Uint8Array<ArrayBuffer>, emptyDepth: number, hidesEmpty: boolean): Promise<void> {
    if (header.projection.kind !== "pinhole" || !header.color || !header.depth) return;
    this.nReceived += 1;
    const number = this.nReceived;
    const [bitmap, { depth, sizePx }] = await Promise.all([
      decodeJpeg(payload, header.color, { colorSpaceConversion: "none" }),
      decodeDepth(header.depth, payload),
    ]);
    if (this.isDisposed || number < this.nShown) {
      bitmap.close();
      return;
    }
    this.nShown = number;
    const { uniforms } = this.mesh.material;
    replace(uniforms.colorMap!, pictureTexture(bitmap));
    replace(uniforms.depthMap!, depthTexture(depth, sizePx));
    uniforms.worldFromPicture!.value = worldFromCamera(header.world_from_camera);
    (uniforms.sizePx!.value as THREE.Vector2).fromArray(header.full_size_px);
    (uniforms.focalPx!.value as THREE.Vector2).fromArray(header.projection.focal_px);
    (uniforms.principalPx!.value as THREE.Vector2).fromArray(header.projection.principal_px);
    uniforms.emptyDepth!.value = emptyDepth;
    uniforms.hidesEmpty!.value = hidesEmpty;
    uniforms.nearestM!.value = nearest(depth, emptyDepth);
  }

  /** Forgets the picture, because it shows another model or place. */
  forget(): void {
    this.nShown = 0;
    this.mesh.visible = false;
  }

  dispose(): void {
    this.isDisposed = true;
    const { uniforms } = this.mesh.material;
    for (const name of ["colorMap", "depthMap"]) (uniforms[name]!.value as THREE.Texture | null)?.dispose();
    this.mesh.geometry.dispose();
    this.mesh.material.dispose();
    this.mesh.removeFromParent();
  }
}

/** The smallest depth of a surface; `empty` if there is none. */
function nearest(depth: Float32Array, empty: number): number {
  let found = empty;
  for (const value of depth) if (value > 0 && value < found) found = value;
  return found;
}

export function pictureTexture(bitmap: ImageBitmap): THREE.Texture {
  const texture = new THREE.Texture(bitmap);
  texture.flipY = false;
  texture.generateMipmaps = false;
  texture.minFilter = THREE.LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

function depthTexture(depth: Float32Array<ArrayBuffer>, [width, height]: [number, number]): THREE.DataTexture {
  const texture = new THREE.DataTexture(depth, width, height, THREE.RedFormat, THREE.FloatType);
  texture.needsUpdate = true;
  return texture;
}

export function replace(slot: THREE.IUniform, texture: THREE.Texture): void {
  const old = slot.value as THREE.Texture | null;
  (old?.image as { close?: () => void } | undefined)?.close?.();
  old?.dispose();
  slot.value = texture;
}
