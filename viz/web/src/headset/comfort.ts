// Darkens the edges of the view while the operator is moved, which makes fewer people sick (Fernandes and Feiner 2016), and
// shows a sentence in front of the operator.

import * as THREE from "three";
import { cut } from "./menu_layout";

/** Distance from the head, and tangents at which the vignette begins and is complete. */
const DISTANCE_M = 0.5;
const CLEAR_TANGENT = 0.45;
const DARK_TANGENT = 0.8;
const OUTER_TANGENT = 4;
/** The vignette opens and closes with this time constant. */
const FADE_SECS = 0.12;

const SIGN_M = { width: 0.5, height: 0.06, distance: 0.9, below: 0.22 };
const SIGN_PX = { width: 1400, height: 168 };

export class Vignette {
  readonly mesh: THREE.Mesh<THREE.RingGeometry, THREE.ShaderMaterial>;
  private strength = 0;

  constructor() {
    const material = new THREE.ShaderMaterial({
      uniforms: { strength: { value: 0 } },
      vertexShader: /* glsl */ `
        varying float tangent;
        void main() {
          tangent = length(position.xy);
          gl_Position = projectionMatrix * modelViewMatrix * vec4(position.xy * ${DISTANCE_M}, -${DISTANCE_M}, 1.0);
        }`,
      fragmentShader: /* glsl */ `
        uniform float strength;
        varying float tangent;
        void main() {
          gl_FragColor = vec4(0.0, 0.0, 0.0, strength * smoothstep(${CLEAR_TANGENT}, ${DARK_TANGENT}, tangent));
        }`,
      transparent: true,
      depthTest: false,
      depthWrite: false,
    });
    this.mesh = new THREE.Mesh(new THREE.RingGeometry(CLEAR_TANGENT, OUTER_TANGENT, 48, 6), material);
    this.mesh.renderOrder = 20;
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
  }

  /** Follows whether the operator is moved. */
  update(isMoving: boolean, secs: number): void {
    const wanted = isMoving ? 1 : 0;
    this.strength += (wanted - this.strength) * Math.min(1, secs / FADE_SECS);
    if (Math.abs(wanted - this.strength) < 0.01) this.strength = wanted;
    this.mesh.visible = this.strength > 0;
    this.mesh.material.uniforms.strength!.value = this.strength;
  }

  dispose(): void {
    this.mesh.geometry.dispose();
    this.mesh.material.dispose();
  }
}

/** A sentence that is always in view, below the middle. */
export class Sign {
  readonly mesh: THREE.Mesh<THREE.PlaneGeometry, THREE.MeshBasicMaterial>;
  private readonly canvas = document.createElement("canvas");
  private shown = "";

  constructor() {
    [this.canvas.width, this.canvas.height] = [SIGN_PX.width, SIGN_PX.height];
    const map = new THREE.CanvasTexture(this.canvas);
    const material = new THREE.MeshBasicMaterial({ map, depthTest: false, transparent: true });
    this.mesh = new THREE.Mesh(new THREE.PlaneGeometry(SIGN_M.width, SIGN_M.height), material);
    this.mesh.position.set(0, -SIGN_M.below, -SIGN_M.distance);
    this.mesh.renderOrder = 21;
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
  }

  /** The sentence; empty if there is none. */
  get text(): string {
    return this.shown;
  }

  set text(text: string) {
    if (text === this.shown) return;
    this.shown = text;
    this.mesh.visible = text !== "";
    if (text === "") return;
    const context = this.canvas.getContext("2d")!;
    context.fillStyle = "#3b1a1a";
    context.fillRect(0, 0, SIGN_PX.width, SIGN_PX.height);
    context.fillStyle = "#ffe1dc";
    context.font = "600 56px system-ui, sans-serif";
    const line = cut(text, SIGN_PX.width - 60, (part) => context.measureText(part).width);
    context.fillText(line, 0.5 * (SIGN_PX.width - context.measureText(line).width), 0.5 * SIGN_PX.height + 20);
    this.mesh.material.map!.needsUpdate = true;
  }

  dispose(): void {
    this.mesh.material.map!.dispose();
    this.mesh.material.dispose();
    this.mesh.geometry.dispose();
  }
}
