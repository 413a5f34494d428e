// Loads the script for steering once a server has an arm that can be steered. The script uses the classes of three.js of the
// page, because a second copy would be large, and its objects would have the same numbers as those of the page.

import * as THREE from "three";
import { action, toggle } from "../keys";
import { RobotLayer } from "../layers/robot_layer";
import { element } from "../panels/element";
import { reasonOf } from "../panels/sentence";
import { showToast } from "../panels/toast";
import type { OrbitView } from "../view/orbit_view";
import type { Steering } from "./steering";

/** The part of three.js that the script uses. tests/steering_loader.test.ts compares it with the imports. */
const SHARED = {
  CylinderGeometry: THREE.CylinderGeometry,
  DoubleSide: THREE.DoubleSide,
  Group: THREE.Group,
  MathUtils: THREE.MathUtils,
  Matrix4: THREE.Matrix4,
  Mesh: THREE.Mesh,
  MeshBasicMaterial: THREE.MeshBasicMaterial,
  MeshLambertMaterial: THREE.MeshLambertMaterial,
  Object3D: THREE.Object3D,
  Plane: THREE.Plane,
  Quaternion: THREE.Quaternion,
  Raycaster: THREE.Raycaster,
  SphereGeometry: THREE.SphereGeometry,
  TorusGeometry: THREE.TorusGeometry,
  Vector2: THREE.Vector2,
  Vector3: THREE.Vector3,
};

export class SteeringLoader {
  private steering: Steering | null = null;
  private isLoading = false;
  private isOffered = false;

  constructor(private readonly view: OrbitView) {}

  /** Whether the server has an arm that can be steered. */
  set offered(isOffered: boolean) {
    if (isOffered === this.isOffered) return;
    this.isOffered = isOffered;
    element("toggle-steer").hidden = !isOffered;
    if (this.steering) this.steering.offered = isOffered;
    else if (isOffered) void this.load();
  }

  private async load(): Promise<void> {
    if (this.isLoading) return;
    this.isLoading = true;
    try {
      Object.assign(globalThis, { fieldrigThree: SHARED });
      const script = await import("./steering");
      const { view } = this;
      const newRobotLayer: ConstructorParameters<typeof Steering>[0]["newRobotLayer"] = (changed, newLook) =>
        new RobotLayer(view.occlusion, changed, newLook);
      this.steering = new script.Steering({ view, newRobotLayer, action, toggle });
      this.steering.offered = this.isOffered;
    } catch (error) {
      this.isOffered = false; // The next status tries again.
      showToast(`Steering cannot be loaded: ${reasonOf(error)}`);
    }
    this.isLoading = false;
  }
}
