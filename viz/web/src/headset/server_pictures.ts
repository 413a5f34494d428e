// Pictures of the server in a headset: one for each eye, a picture in the hand, and a sphere around the operator.

import * as THREE from "three";
import type { View } from "../connection/render_scheduler";
import type { PictureRequest, SideView } from "../layers/side_view";
import { decodeJpeg } from "../layers/jpeg";
import { cameraOfThree, rowMajorPose, worldFromCamera } from "../view/convention";
import { DepthPicture, pictureTexture, replace } from "./depth_picture";
import type { EyeLens } from "./eye_lens";
import type { Hand } from "./hand_input";
import { HANDHELD_LIMITS, type RefreshLimits, RefreshRule, SPHERE_LIMITS } from "./refresh_rule";

/** Pictures for the eyes are wider than the eyes see, so that turning the head shows no edge at once. */
const MARGIN = 0.12;
/** Largest side of a picture for an eye, pixels. */
const MAX_EYE_PX = 1024;
/** A new picture for the eyes after these motions. */
const EYE_LIMITS: RefreshLimits = { meters: 0.004, rad: 0.003 };
/** Without an answer for this time, the next picture is requested. */
const TIMEOUT_MILLIS = 30_000;
/** The picture in the hand is twice as wide as high: 256 pixels times the resolution. */
const HAND_HEIGHT_PX = 256;
const HAND_PANEL_M = 0.36;
const HAND_AHEAD_M = 0.12;
/** Height of the panorama: 256 pixels times the resolution. */
const SPHERE_HEIGHT_PX = 256;
const SPHERE_M = 50;
/** How much a step of the zoom changes the focal length, and its limits in heights of the picture. */
const ZOOM_STEP = 1.4;
const ZOOM_LIMITS = [0.3, 8] as const;

export interface ServerPictureParts {
  sides: { left: SideView; right: SideView; extra: SideView };
  /** The fields of a request that all pictures have in common. */
  request(view: View): Omit<PictureRequest, "outputs">;
  isTraining(): boolean;
}

/** What the pictures need to know in each frame. */
export interface PictureFrame {
  nowMillis: number;
  worldFromHeadset: THREE.Matrix4;
  /** Meters of the world per meter of the room. */
  scale: number;
  headView: View;
  hasPassthrough: boolean;
}

/** One picture for each eye, with depth, from the poses of the eyes. */
export class EyePictures {
  readonly root = new THREE.Group();
  private readonly pictures = [new DepthPicture("in world"), new DepthPicture("in world")] as const;
  private readonly rule = new RefreshRule(EYE_LIMITS);
  private pending = 0;
  private askedAt = -Infinity;

  constructor(private readonly parts: ServerPictureParts) {
    for (const [ix, { mesh }] of this.pictures.entries()) {
      mesh.layers.set(1 + ix); // three.js shows layer 1 to the left eye, and layer 2 to the right eye.
      mesh.visible = true;
      this.root.add(mesh);
    }
    this.root.visible = false;
  }

  /** Whether both eyes have a picture. */
  get isReady(): boolean {
    return this.pictures.every(({ hasPicture }) => hasPicture);
  }

  /** Requests pictures if the eyes have moved. */
  update(frame: PictureFrame, eyes: readonly THREE.PerspectiveCamera[], lenses: readonly EyeLens[]): void {
    if (eyes.length < 2 || lenses.length < 2) return;
    if (this.pending > 0 && frame.nowMillis - this.askedAt < TIMEOUT_MILLIS) return;
    const left = eyes[0]!.matrixWorld.clone();
    const inRoom = left.setPosition(new THREE.Vector3().setFromMatrixPosition(left).divideScalar(frame.scale));
    if (!this.rule.isDue(inRoom, frame.nowMillis, this.parts.isTraining())) return;
    this.askedAt = frame.nowMillis;
    this.pending = 0;
    for (const [ix, side] of [this.parts.sides.left, this.parts.sides.right].entries()) {
      void this.request(ix as 0 | 1, side, frame, eyes[ix]!, lenses[ix]!);
    }
  }

  /** Forgets the pictures, because they show another model or scale. */
  forget(): void {
    this.rule.forget();
    for (const picture of this.pictures) picture.forget();
    for (const { mesh } of this.pictures) mesh.visible = true;
  }

  dispose(): void {
    for (const picture of this.pictures) picture.dispose();
    for (const side of [this.parts.sides.left, this.parts.sides.right]) side.abandon("the headset was left");
    this.root.removeFromParent();
  }

  private async request(ix: 0 | 1, side: SideView, frame: PictureFrame, eye: THREE.PerspectiveCamera, lens: EyeLens): Promise<void> {
    this.pending += 1;
    try {
      const view = {
        ...frame.headView,
        world_from_camera: rowMajorPose(cameraOfThree(eye.matrixWorld)),
        ...withMargin(lens),
      };
      const { header, payload } = await side.request({ ...this.parts.request(view), outputs: ["color", "depth"] });
      await this.pictures[ix].show(header, payload, 0.9 * frame.headView.far_m, frame.hasPassthrough);
    } catch {
      this.rule.forget(); // The next frame asks again.
    } finally {
      this.pending = Math.max(0, this.pending - 1);
    }
  }
}

/** The lens of a picture for an eye: pixels coincide with those of the eye where the size permits. */
export function withMargin({ sizePx, focalPx, principalPx }: EyeLens): Pick<View, "size_px" | "projection"> {
  const scale = Math.min(1, MAX_EYE_PX / (Math.max(...sizePx) * (1 + 2 * MARGIN)));
  const margin = sizePx.map((side) => Math.round(side * scale * MARGIN));
  const of = (px: [number, number], offset: readonly number[]): [number, number] => [px[0] * scale + offset[0]!, px[1] * scale + offset[1]!];
  const size = of(sizePx, [2 * margin[0]!, 2 * margin[1]!]).map(Math.round) as [number, number];
  return { size_px: size, projection: { kind: "pinhole", focal_px: of(focalPx, [0, 0]), principal_px: of(principalPx, margin) } };
}

/** A picture from the hand, on a panel in the hand, with a relief. */
export class HandPicture {
  readonly picture = new DepthPicture("relief");
  private readonly rule = new RefreshRule(HANDHELD_LIMITS);
  private isPending = false;
  private askedAt = -Infinity;
  /** Focal length in heights of the picture, and the resolution. */
  private zoom = 1;
  resolution = 1;

  constructor(private readonly parts: ServerPictureParts) {
    this.picture.mesh.matrixAutoUpdate = false;
  }

  /** Requests a picture, because it shows another model. */
  forget(): void {
    this.rule.forget();
  }

  /** Changes the focal length by one step. */
  changeZoom(isIn: boolean): void {
    const zoom = this.zoom * (isIn ? ZOOM_STEP : 1 / ZOOM_STEP);
    this.zoom = THREE.MathUtils.clamp(zoom, ...ZOOM_LIMITS);
    this.rule.forget();
  }

  /** Puts the panel into a hand, and requests a picture if the hand has moved. */
  update(frame: PictureFrame, hand: Hand | null): void {
    const { mesh } = this.picture;
    mesh.visible = hand !== null && this.picture.hasPicture;
    if (!hand) return;
    const headsetFromPanel = panelOf(hand);
    mesh.matrix.copy(headsetFromPanel).scale(new THREE.Vector3(HAND_PANEL_M, HAND_PANEL_M, 1));
    mesh.matrixWorldNeedsUpdate = true;
    if (this.isPending && frame.nowMillis - this.askedAt < TIMEOUT_MILLIS) return;
    if (!this.rule.isDue(headsetFromPanel, frame.nowMillis, this.parts.isTraining())) return;
    this.askedAt = frame.nowMillis;
    void this.request(frame, headsetFromPanel);
  }

  private async request(frame: PictureFrame, headsetFromPanel: THREE.Matrix4): Promise<void> {
    this.isPending = true;
    const height = HAND_HEIGHT_PX * this.resolution;
    const focal = this.zoom * height;
    try {
      const view: View = {
        ...frame.headView,
        world_from_camera: rowMajorPose(cameraOfThree(frame.worldFromHeadset.clone().multiply(headsetFromPanel))),
        size_px: [2 * height, height],
        projection: { kind: "pinhole", focal_px: [focal, focal], principal_px: [height, 0.5 * height] },
      };
      const { header, payload } = await this.parts.sides.extra.request({ ...this.parts.request(view), outputs: ["color", "depth"] });
      await this.picture.show(header, payload, 0.9 * frame.headView.far_m, false);
    } catch {
      this.rule.forget();
    } finally {
      this.isPending = false;
    }
  }

  dispose(): void {
    this.picture.dispose();
    this.parts.sides.extra.abandon("the headset was left");
  }
}

/** Where the panel is: in front of the hand, facing back along its ray. */
function panelOf({ ray, grip }: Hand): THREE.Matrix4 {
  const at = new THREE.Vector3().setFromMatrixPosition(grip).addScaledVector(ray.direction, HAND_AHEAD_M);
  const up = Math.abs(ray.direction.y) > 0.95 ? new THREE.Vector3(0, 0, -1) : new THREE.Vector3(0, 1, 0);
  return new THREE.Matrix4().lookAt(at, at.clone().add(ray.direction), up).setPosition(at);
}

const SPHERE_VERTEX = /* glsl */ `
  varying vec3 direction;
  void main() {
    direction = position;
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  }`;

const SPHERE_FRAGMENT = /* glsl */ `
  uniform sampler2D colorMap;
  uniform float opacity;
  varying vec3 direction;
  void main() {
    // x right, y down, z forward; the forward direction is in the middle of the panorama.
    vec3 d = normalize(direction);
    vec2 uv = vec2(atan(d.x, d.z) / 6.283185307179586 + 0.5, asin(clamp(d.y, -1.0, 1.0)) / 3.141592653589793 + 0.5);
    gl_FragColor = vec4(textureLod(colorMap, uv, 0.0).rgb, opacity);
  }`;

/** A panorama from the head, on a sphere around it. */
export class SpherePicture {
  readonly mesh: THREE.Mesh<THREE.SphereGeometry, THREE.ShaderMaterial>;
  resolution = 2;
  private readonly rule = new RefreshRule(SPHERE_LIMITS);
  private isPending = false;
  private askedAt = -Infinity;
  private hasPicture = false;
  private isDisposed = false;

  constructor(private readonly parts: ServerPictureParts) {
    const material = new THREE.ShaderMaterial({
      vertexShader: SPHERE_VERTEX,
      fragmentShader: SPHERE_FRAGMENT,
      uniforms: { colorMap: { value: null }, opacity: { value: 1 } },
      side: THREE.DoubleSide,
      transparent: true,
      depthWrite: false,
    });
    this.mesh = new THREE.Mesh(new THREE.SphereGeometry(1, 48, 24), material);
    this.mesh.renderOrder = -5;
    this.mesh.matrixAutoUpdate = false;
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
  }

  /** Requests a panorama, because it shows another model. */
  forget(): void {
    this.rule.forget();
  }

  get opacity(): number {
    return this.mesh.material.uniforms.opacity!.value as number;
  }

  set opacity(opacity: number) {
    this.mesh.material.uniforms.opacity!.value = opacity;
  }

  /** Requests a panorama if the head has moved. */
  update(frame: PictureFrame, isShown: boolean): void {
    this.mesh.visible = isShown && this.hasPicture;
    if (!isShown || (this.isPending && frame.nowMillis - this.askedAt < TIMEOUT_MILLIS)) return;
    const worldFromHead = worldFromCamera(frame.headView.world_from_camera);
    const inRoom = new THREE.Matrix4().setPosition(new THREE.Vector3().setFromMatrixPosition(worldFromHead).divideScalar(frame.scale));
    if (!this.rule.isDue(inRoom, frame.nowMillis, this.parts.isTraining())) return;
    this.askedAt = frame.nowMillis;
    void this.request(frame, worldFromHead);
  }

  dispose(): void {
    this.isDisposed = true;
    (this.mesh.material.uniforms.colorMap!.value as THREE.Texture | null)?.dispose();
    this.mesh.geometry.dispose();
    this.mesh.material.dispose();
    this.mesh.removeFromParent();
  }

  private async request(frame: PictureFrame, worldFromHead: THREE.Matrix4): Promise<void> {
    this.isPending = true;
    const height = SPHERE_HEIGHT_PX * this.resolution;
    try {
      const common = this.parts.request(frame.headView);
      const { header, payload } = await this.parts.sides.extra.request({
        ...common,
        projection: { kind: "equirectangular" },
        size_px: [2 * height, height],
        outputs: ["color"],
      });
      if (!header.color) return;
      const bitmap = await decodeJpeg(payload, header.color, { colorSpaceConversion: "none" });
      if (this.isDisposed) {
        bitmap.close();
        return;
      }
      replace(this.mesh.material.uniforms.colorMap!, pictureTexture(bitmap));
      const radius = SPHERE_M * frame.scale;
      this.mesh.matrix.copy(worldFromHead).scale(new THREE.Vector3(radius, radius, radius));
      this.mesh.matrixWorldNeedsUpdate = true;
      this.hasPicture = true;
    } catch {
      this.rule.forget();
    } finally {
      this.isPending = false;
    }
  }
}
