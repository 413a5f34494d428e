// The images of the cameras: in the scene, at the end of the frustum of each camera with a pose, and as panels beside the
// operator. They are the images that the page shows, which stay in its document.

import * as THREE from "three";
import type { PosedCamera } from "../connection/protocol";
import { worldFromCamera } from "../view/convention";

/** Width of a panel, and where the row of panels is around the head, meters. */
const PANEL_WIDTH_M = 0.42;
const DISTANCE_M = 1.1;
const BELOW_EYES_M = -0.15;
/** Angle between two panels, and from the direction of the view to the first one, radians. */
const STEP_RAD = 0.42;
const FIRST_RAD = 0.55;
/** Images arrive at 4 Hz, or at 12 Hz for one camera. */
const UPLOAD_MILLIS = 80;

interface Panel {
  texture: THREE.CanvasTexture;
  sizeKey: string;
  /** In the scene. */
  placed: THREE.Mesh<THREE.PlaneGeometry, THREE.MeshBasicMaterial>;
  /** Beside the operator. */
  beside: THREE.Mesh<THREE.PlaneGeometry, THREE.MeshBasicMaterial>;
}

export class ImagePanels {
  /** The images in the scene, in the world. */
  readonly inScene = new THREE.Group();
  /** The row of panels, in the space of the headset. */
  readonly besideOperator = new THREE.Group();
  private readonly panels = new Map<string, Panel>();
  private uploadedAt = -Infinity;

  /** Adopts the newest images and poses. `depthM`: depth of the drawn frustums. */
  update(posed: readonly PosedCamera[], depthM: number, nowMillis: number): void {
    if (!this.inScene.visible && !this.besideOperator.visible) return;
    if (nowMillis - this.uploadedAt < UPLOAD_MILLIS) return;
    this.uploadedAt = nowMillis;
    const canvases = shownImages();
    for (const [camera, panel] of this.panels) if (!canvases.has(camera)) this.remove(camera, panel);
    for (const [camera, canvas] of canvases) {
      const panel = this.panelOf(camera, canvas);
      panel.texture.needsUpdate = true;
      const pose = posed.find((other) => other.camera === camera);
      panel.placed.visible = pose !== undefined;
      if (pose) placeInScene(panel.placed, pose, depthM);
    }
  }

  /** Puts the row of panels around a head. */
  placeAround(headInHeadset: THREE.Vector3, yawRad: number): void {
    this.besideOperator.position.copy(headInHeadset);
    this.besideOperator.rotation.set(0, yawRad, 0);
    this.arrange();
  }

  dispose(): void {
    for (const [camera, panel] of this.panels) this.remove(camera, panel);
    for (const root of [this.inScene, this.besideOperator]) root.removeFromParent();
  }

  /** The panel of a camera; a new one if its image has another size. */
  private panelOf(camera: string, canvas: HTMLCanvasElement): Panel {
    const sizeKey = `${canvas.width} ${canvas.height}`;
    const before = this.panels.get(camera);
    if (before?.sizeKey === sizeKey && before.texture.image === canvas) return before;
    if (before) this.remove(camera, before);
    const texture = new THREE.CanvasTexture(canvas);
    const mesh = (): Panel["placed"] => {
      const material = new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide });
      return new THREE.Mesh(new THREE.PlaneGeometry(1, 1), material);
    };
    const panel: Panel = { texture, sizeKey, placed: mesh(), beside: mesh() };
    panel.placed.matrixAutoUpdate = false;
    panel.placed.visible = false;
    panel.beside.scale.set(PANEL_WIDTH_M, (PANEL_WIDTH_M * canvas.height) / canvas.width, 1);
    this.inScene.add(panel.placed);
    this.besideOperator.add(panel.beside);
    this.panels.set(camera, panel);
    this.arrange();
    return panel;
  }

  /** Places the panels in a row to the left of the operator. */
  private arrange(): void {
    [...this.panels.values()].forEach(({ beside }, ix) => {
      const angle = FIRST_RAD + ix * STEP_RAD;
      beside.position.set(-DISTANCE_M * Math.sin(angle), BELOW_EYES_M, -DISTANCE_M * Math.cos(angle));
      beside.rotation.set(0, angle, 0);
    });
  }

  private remove(camera: string, { texture, placed, beside }: Panel): void {
    texture.dispose();
    for (const mesh of [placed, beside]) {
      mesh.geometry.dispose();
      mesh.material.dispose();
      mesh.removeFromParent();
    }
    this.panels.delete(camera);
  }
}

/** The images that the page shows, by camera. */
function shownImages(): Map<string, HTMLCanvasElement> {
  const images = new Map<string, HTMLCanvasElement>();
  for (const figure of document.querySelectorAll<HTMLElement>("figure[data-camera]")) {
    const canvas = figure.querySelector("canvas");
    if (canvas && canvas.width > 0) images.set(figure.dataset.camera!, canvas);
  }
  return images;
}

/** Fills the end of a camera's frustum with its image. */
function placeInScene(mesh: THREE.Mesh, { world_from_camera, size_px, focal_px, principal_px }: PosedCamera, depthM: number): void {
  const [width, height] = [0, 1].map((axis) => (size_px[axis]! / focal_px[axis]!) * depthM) as [number, number];
  const center = [0, 1].map((axis) => ((0.5 * size_px[axis]! - principal_px[axis]!) / focal_px[axis]!) * depthM);
  // The plane has its y axis up, and the camera down.
  const cameraFromPlane = new THREE.Matrix4()
    .makeTranslation(center[0]!, center[1]!, depthM)
    .multiply(new THREE.Matrix4().makeScale(width, -height, 1));
  mesh.matrix.copy(worldFromCamera(world_from_camera)).multiply(cameraFromPlane);
  mesh.matrixWorldNeedsUpdate = true;
}
