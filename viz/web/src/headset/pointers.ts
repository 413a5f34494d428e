// What the hands look like: a small body where each hand is, its ray, and the place of a jump.

import * as THREE from "three";
import type { Hand } from "./hand_input";

const HAND_COLOR = 0xc8d3df;
const RAY_COLOR = 0x4cc2a6;
const PRESSED_COLOR = 0xffc857;
/** Length of a ray that points at nothing, meters. */
const RAY_M = 1.2;
const JUMP_RADIUS_M = 0.22;

interface Drawn {
  body: THREE.Mesh;
  ray: THREE.Mesh<THREE.CylinderGeometry, THREE.MeshBasicMaterial>;
}

export class Pointers {
  readonly root = new THREE.Group();
  private readonly drawn: Drawn[];
  private readonly target: THREE.Mesh<THREE.RingGeometry, THREE.MeshBasicMaterial>;

  constructor() {
    const body = new THREE.CapsuleGeometry(0.018, 0.07, 4, 12).rotateX(Math.PI / 2);
    // A cylinder of unit length along -z.
    const ray = new THREE.CylinderGeometry(0.0012, 0.0012, 1, 6).rotateX(Math.PI / 2).translate(0, 0, -0.5);
    this.drawn = [0, 1].map(() => ({
      body: new THREE.Mesh(body, new THREE.MeshLambertMaterial({ color: HAND_COLOR })),
      ray: new THREE.Mesh(ray, new THREE.MeshBasicMaterial({ color: RAY_COLOR, depthTest: false, transparent: true })),
    }));
    for (const { ray: line } of this.drawn) line.renderOrder = 16; // Over the menu at which it points.
    const ring = new THREE.RingGeometry(0.7 * JUMP_RADIUS_M, JUMP_RADIUS_M, 32).rotateX(-Math.PI / 2);
    this.target = new THREE.Mesh(ring, new THREE.MeshBasicMaterial({ color: RAY_COLOR, side: THREE.DoubleSide }));
    this.target.visible = false;
    for (const { body: mesh, ray: line } of this.drawn) {
      mesh.matrixAutoUpdate = false;
      this.root.add(mesh, line);
    }
    this.root.add(this.target);
  }

  /** Draws the pointing hand, then the other one. `menuM`: distance of the menu along the ray; `jump`: place of a jump. */
  update([pointing, holding]: readonly [Hand | null, Hand | null], menuM: number | null, jump: THREE.Vector3 | null): void {
    [pointing, holding].forEach((hand, ix) => {
      const { body, ray } = this.drawn[ix]!;
      body.visible = hand !== null;
      ray.visible = hand !== null && ix === 0;
      if (!hand) return;
      body.matrix.copy(hand.grip);
      if (!ray.visible) return;
      ray.position.copy(hand.ray.from);
      ray.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, -1), hand.ray.direction);
      ray.scale.set(1, 1, menuM ?? RAY_M);
      ray.material.color.setHex(hand.isTrigger ? PRESSED_COLOR : RAY_COLOR);
    });
    this.target.visible = jump !== null;
    if (jump) this.target.position.copy(jump);
  }

  dispose(): void {
    for (const { body, ray } of this.drawn) {
      body.geometry.dispose();
      (body.material as THREE.Material).dispose();
      ray.geometry.dispose();
      ray.material.dispose();
    }
    this.target.geometry.dispose();
    this.target.material.dispose();
    this.root.removeFromParent();
  }
}
