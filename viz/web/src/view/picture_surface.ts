// Points on the model's surface, from the depth of the newest picture.

import * as THREE from "three";
import type { PictureLayer } from "../layers/picture_layer";
import { nearestSurface, surfacePoint } from "./surface_picker";

export class PictureSurface {
  constructor(
    private readonly picture: PictureLayer,
    private readonly camera: THREE.PerspectiveCamera,
    private readonly canvas: HTMLCanvasElement,
  ) {}

  /** The point at a pixel of the canvas, or a few pixels beside it if it has none; null if there is none. */
  at(x: number, y: number): THREE.Vector3 | null {
    const { clientWidth, clientHeight } = this.canvas;
    const raycaster = new THREE.Raycaster();
    const onPixel = (u: number, v: number): THREE.Vector3 | null => {
      raycaster.setFromCamera(new THREE.Vector2((2 * u) / clientWidth - 1, 1 - (2 * v) / clientHeight), this.camera);
      return this.on(raycaster.ray);
    };
    return nearestSurface(onPixel, x, y);
  }

  /** The point at the middle of the canvas; null if there is none. */
  ahead(): THREE.Vector3 | null {
    return this.at(0.5 * this.canvas.clientWidth, 0.5 * this.canvas.clientHeight);
  }

  /** The point in the direction of another one; null if there is none. */
  toward(point: THREE.Vector3): THREE.Vector3 | null {
    return this.on(new THREE.Ray(this.camera.position.clone()).lookAt(point));
  }

  private on(ray: THREE.Ray): THREE.Vector3 | null {
    const depth = this.picture.posedDepth;
    return depth && surfacePoint(ray, depth, this.camera.near, this.camera.far);
  }
}
