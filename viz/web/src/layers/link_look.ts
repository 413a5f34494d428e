// How a link of the robot is drawn. It has its own colors. It is faint while its pose is outdated,
// and fades close to the eye.

import * as THREE from "three";
import { type Occlusion, SOLID } from "./occlusion";

/** Opacity while the pose is outdated. */
const OUTDATED_OPACITY = 0.35;
/** A link fades between these distances to the eye, meters. A closer link would fill the view. */
const HIDDEN_M = 0.08;
const FULL_M = 0.3;

/** Opacity of a link whose nearest part is at this distance from the eye. */
export function nearOpacity(distanceM: number): number {
  return THREE.MathUtils.smoothstep(distanceM, HIDDEN_M, FULL_M);
}

/** Materials of the shapes of a link. */
export interface Look {
  /** The material of shapes of a color. */
  material(color: readonly number[]): THREE.MeshLambertMaterial;
  /** Draws a mesh as a part of the link. Returns what to draw besides at the same place. */
  add(mesh: THREE.Mesh): THREE.Object3D;
  outdated: boolean;
  /** Fades the link if it is close to the eye. */
  fadeNear(eye: THREE.Vector3): void;
}

export class LinkLook implements Look {
  private readonly materials = new Map<string, THREE.MeshLambertMaterial>();
  private readonly meshes: THREE.Mesh[] = [];
  /** Writes only depth, so that a faint link does not show its own inside. */
  private readonly depthOnly: THREE.MeshBasicMaterial;
  private isOutdated = false;
  private nearness = 1;

  constructor(private readonly occlusion: Occlusion) {
    const material = new THREE.MeshBasicMaterial({ colorWrite: false, side: THREE.DoubleSide, visible: false });
    this.depthOnly = occlusion.apply(material, SOLID);
  }

  /** The shapes of one color share a material. */
  material(color: readonly number[]): THREE.MeshLambertMaterial {
    const key = color.map((channel) => channel.toFixed(3)).join();
    let material = this.materials.get(key);
    if (!material) {
      const [red, green, blue, opacity] = color as [number, number, number, number];
      const look = new THREE.MeshLambertMaterial({
        color: new THREE.Color(red, green, blue),
        side: THREE.DoubleSide,
        // Two passes would prepare the shader of each faint part again in every frame.
        forceSinglePass: true,
      });
      material = this.occlusion.apply(look, SOLID);
      material.userData.opacity = opacity;
      this.materials.set(key, material);
      this.apply();
    }
    return material;
  }

  /** Draws a mesh as a part of the link. Returns the mesh to draw at the same place, for its depth. */
  add(mesh: THREE.Mesh): THREE.Mesh {
    this.meshes.push(mesh);
    return new THREE.Mesh(mesh.geometry, this.depthOnly);
  }

  get outdated(): boolean {
    return this.isOutdated;
  }

  /** Draws the link faintly while its pose is outdated. */
  set outdated(isOutdated: boolean) {
    this.isOutdated = isOutdated;
    this.apply();
  }

  /** Fades the link if it is close to the eye. */
  fadeNear(eye: THREE.Vector3): void {
    const distances = this.meshes.map((mesh) => distanceToBox(mesh, eye));
    const nearness = nearOpacity(Math.min(Infinity, ...distances));
    if (nearness === this.nearness) return;
    this.nearness = nearness;
    this.apply();
  }

  private apply(): void {
    for (const material of this.materials.values()) {
      const opacity = (material.userData.opacity as number) * (this.isOutdated ? OUTDATED_OPACITY : 1) * this.nearness;
      material.opacity = opacity;
      material.visible = opacity > 0;
      material.transparent = opacity < 1;
    }
    // A link that fades must not hide what lies behind it.
    this.depthOnly.visible = this.isOutdated && this.nearness === 1;
  }
}

/** Distance from a point to the box around a mesh, meters; 0 inside. */
function distanceToBox(mesh: THREE.Mesh, point: THREE.Vector3): number {
  if (!mesh.geometry.boundingBox) mesh.geometry.computeBoundingBox();
  const local = point.clone().applyMatrix4(mesh.matrixWorld.clone().invert());
  const nearest = mesh.geometry.boundingBox!.clampPoint(local, new THREE.Vector3());
  return nearest.applyMatrix4(mesh.matrixWorld).distanceTo(point);
}
