// Hides objects behind the model. Each fragment is compared with the depth of the newest picture at
// its own pixel, or with the depth of the splats that the page draws.
//
// The comparison takes place in the camera of the picture. It is exact where the view and the
// picture agree, and nearly exact while the next picture is pending.

import * as THREE from "three";

/** Distances by which a fragment may lie behind the surface: relative to its depth, and in meters. */
export interface Tolerance {
  relative: number;
  meters: number;
}

/** For lines, which often lie on a surface. */
export const ON_SURFACE: Tolerance = { relative: 0.012, meters: 0.004 };
/** For solid bodies: the error of the depth. */
export const SOLID: Tolerance = { relative: 0.004, meters: 0.003 };

const VERTEX = /* glsl */ `
  varying vec3 occlusionPoint;`;

const FRAGMENT = /* glsl */ `
  varying vec3 occlusionPoint;
  uniform sampler2D occlusionDepth;
  uniform mat4 pictureFromWorld;
  uniform vec2 occlusionSizePx;
  uniform vec2 occlusionFocalPx;
  uniform vec2 occlusionPrincipalPx;
  uniform bool occlusionIsOn;
  uniform bool occlusionIsWeighted;
  uniform vec2 occlusionTolerance;
  float depthAt(vec2 uv) {
    if (!occlusionIsWeighted) return texture2D(occlusionDepth, uv).r;
    // Rendered textures begin at the bottom. Nearly transparent splats hide nothing.
    vec2 sums = texture2D(occlusionDepth, vec2(uv.x, 1.0 - uv.y)).rg;
    return sums.g > 0.5 ? sums.r / sums.g : 0.0;
  }
  // The smaller of two differences. It is the change of depth along the surface, without the step
  // at its edge.
  float depthChange(float depth, float before, float after) {
    float a = before > 0.0 ? abs(before - depth) : 1e9;
    float b = after > 0.0 ? abs(after - depth) : 1e9;
    float smaller = min(a, b);
    return smaller < 0.5 * depth ? smaller : 0.0;
  }
  bool isOccluded() {
    if (!occlusionIsOn) return false;
    vec3 p = (pictureFromWorld * vec4(occlusionPoint, 1.0)).xyz;
    if (p.z <= 0.0) return false;
    vec2 uv = (occlusionFocalPx * p.xy / p.z + occlusionPrincipalPx) / occlusionSizePx;
    if (any(lessThan(uv, vec2(0.0))) || any(greaterThan(uv, vec2(1.0)))) return false;
    float depth = depthAt(uv);
    if (!(depth > 0.0)) return false;
    vec2 texel = 1.0 / vec2(textureSize(occlusionDepth, 0));
    float change = depthChange(depth, depthAt(uv - vec2(texel.x, 0.0)), depthAt(uv + vec2(texel.x, 0.0)))
      + depthChange(depth, depthAt(uv - vec2(0.0, texel.y)), depthAt(uv + vec2(0.0, texel.y)));
    return p.z > depth * (1.0 + occlusionTolerance.x) + occlusionTolerance.y + change;
  }`;

/** Depth and the camera that sees it. */
export interface OcclusionDepth {
  /** Depth in meters. The caller keeps the texture and frees it. */
  texture: THREE.Texture;
  /** Whether the texture holds sums of weighted depths and of weights instead. */
  isWeighted: boolean;
  worldFromPicture: THREE.Matrix4;
  sizePx: [number, number];
  focalPx: [number, number];
  principalPx: [number, number];
}

/** The depth that hides what lies behind it. */
export class Occlusion {
  private readonly shared = {
    occlusionDepth: { value: null as THREE.Texture | null },
    pictureFromWorld: { value: new THREE.Matrix4() },
    occlusionSizePx: { value: new THREE.Vector2(1, 1) },
    occlusionFocalPx: { value: new THREE.Vector2(1, 1) },
    occlusionPrincipalPx: { value: new THREE.Vector2() },
    occlusionIsOn: { value: false },
    occlusionIsWeighted: { value: false },
  };
  private pictured: OcclusionDepth | null = null;
  private drawn: OcclusionDepth | null = null;
  private isOn = true;
  private isByDepthBuffer = false;

  /** Whether anything is hidden. */
  set enabled(enabled: boolean) {
    this.isOn = enabled;
    this.update();
  }

  get enabled(): boolean {
    return this.isOn;
  }

  /** Sets whether the depth buffer contains the model, so that the picture is not needed. */
  set usesDepthBuffer(usesDepthBuffer: boolean) {
    this.isByDepthBuffer = usesDepthBuffer;
    this.update();
  }

  /** Adopts the depth of the newest picture. */
  set picture(depth: OcclusionDepth) {
    this.pictured = depth;
    this.update();
  }

  /** Adopts the depth of the model that the page draws; null if it draws none, so that the picture's depth is used. */
  set local(depth: OcclusionDepth | null) {
    this.drawn = depth;
    this.update();
  }

  private update(): void {
    const depth = this.drawn ?? this.pictured;
    this.shared.occlusionIsOn.value = this.isOn && depth !== null && !this.isByDepthBuffer;
    if (!depth) return;
    this.shared.occlusionDepth.value = depth.texture;
    this.shared.occlusionIsWeighted.value = depth.isWeighted;
    this.shared.pictureFromWorld.value.copy(depth.worldFromPicture).invert();
    this.shared.occlusionSizePx.value.fromArray(depth.sizePx);
    this.shared.occlusionFocalPx.value.fromArray(depth.focalPx);
    this.shared.occlusionPrincipalPx.value.fromArray(depth.principalPx);
  }

  /** Makes a material of three.js hide its occluded fragments. */
  apply<M extends THREE.Material>(material: M, tolerance: Tolerance): M {
    const own = { occlusionTolerance: { value: new THREE.Vector2(tolerance.relative, tolerance.meters) } };
    material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, this.shared, own);
      shader.vertexShader = `${VERTEX}\n${shader.vertexShader}`.replace(
        "#include <project_vertex>",
        "#include <project_vertex>\n  occlusionPoint = (modelMatrix * vec4(transformed, 1.0)).xyz;",
      );
      shader.fragmentShader = `${FRAGMENT}\n${shader.fragmentShader}`.replace(
        "void main() {",
        "void main() {\n  if (isOccluded()) discard;",
      );
    };
    return material;
  }
}
