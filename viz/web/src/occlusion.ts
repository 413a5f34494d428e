// Hides what lies behind the model: each fragment is compared with the depth of the newest picture at its own pixel.
//
// The comparison takes place in the camera of the picture. It is exact where the view and the picture agree, and close
// to it while the next picture is pending.

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
  uniform vec2 occlusionTolerance;
  float depthAt(vec2 uv) { return texture2D(occlusionDepth, uv).r; }
  // The smaller of two differences: the change of depth along the surface, but not the step at its edge.
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

/** The picture that hides what lies behind it. */
export class Occlusion {
  private readonly shared = {
    occlusionDepth: { value: null as THREE.Texture | null },
    pictureFromWorld: { value: new THREE.Matrix4() },
    occlusionSizePx: { value: new THREE.Vector2(1, 1) },
    occlusionFocalPx: { value: new THREE.Vector2(1, 1) },
    occlusionPrincipalPx: { value: new THREE.Vector2() },
    occlusionIsOn: { value: false },
  };
  private hasPicture = false;
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

  private update(): void {
    this.shared.occlusionIsOn.value = this.isOn && this.hasPicture && !this.isByDepthBuffer;
  }

  /** Adopts the depth of a picture; `depth` stays the property of the caller. */
  setPicture(
    depth: THREE.Texture,
    worldFromPicture: THREE.Matrix4,
    sizePx: [number, number],
    focalPx: [number, number],
    principalPx: [number, number],
  ): void {
    this.shared.occlusionDepth.value = depth;
    this.shared.pictureFromWorld.value.copy(worldFromPicture).invert();
    this.shared.occlusionSizePx.value.fromArray(sizePx);
    this.shared.occlusionFocalPx.value.fromArray(focalPx);
    this.shared.occlusionPrincipalPx.value.fromArray(principalPx);
    this.hasPicture = true;
    this.update();
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
