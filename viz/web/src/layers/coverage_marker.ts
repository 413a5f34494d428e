// An arrow that points down at the worst observed place. It is drawn over everything else.

import * as THREE from "three";

const COLOR = 0xe3b341;
/** Height of the arrow, relative to the radius of the scene. */
const HEIGHT_RADII = 0.22;

export class CoverageMarker {
  readonly root = new THREE.Group();

  constructor() {
    const material = new THREE.MeshBasicMaterial({ color: COLOR, transparent: true, opacity: 0.85, depthTest: false });
    const part = (geometry: THREE.BufferGeometry, z: number): THREE.Mesh => {
      // Cylinders and cones stand along y, the world is z up.
      const mesh = new THREE.Mesh(geometry.rotateX(z > 0.5 ? Math.PI / 2 : -Math.PI / 2), material);
      mesh.position.z = z;
      mesh.renderOrder = 3;
      return mesh;
    };
    const head = part(new THREE.ConeGeometry(0.14, 0.4, 16), 0.2);
    const shaft = part(new THREE.CylinderGeometry(0.045, 0.045, 0.6, 12), 0.7);
    this.root.add(head, shaft);
    this.root.visible = false;
  }

  /** Shows the arrow at a point in world, in a scene of this radius; null hides it. */
  show(pointM: [number, number, number] | null, radiusM: number): void {
    this.root.visible = pointM !== null;
    if (pointM) this.root.position.fromArray(pointM);
    this.root.scale.setScalar(HEIGHT_RADII * radiusM);
  }
}
