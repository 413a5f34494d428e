// The main view: free camera that orbits or flies, newest picture, lines on top.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { pinholeOfThreeCamera, poseOfThreeCamera, worldFromCamera } from "./convention";
import type { PathView } from "./camera_path";
import { CropBox } from "./crop_box";
import { type DepthMap, PictureDepthMap } from "../layers/depth_map";
import { EyeGuard, type Viewpoint } from "./eye_guard";
import { FlyControls } from "./fly_controls";
import { FrameLayer } from "../layers/frame_layer";
import { LocalModel } from "../layers/local_model";
import { MeasureTool } from "./measure";
import { ObservationLayer } from "../layers/observation_layer";
import { Occlusion, type OcclusionDepth } from "../layers/occlusion";
import { Overlays } from "../layers/overlays";
import { PictureLayer } from "../layers/picture_layer";
import { PointsLayer } from "../layers/points_layer";
import type { PosedCamera, Scene } from "../connection/protocol";
import type { View } from "../connection/render_scheduler";
import { RobotLayer } from "../layers/robot_layer";
import { ScanLayer } from "../layers/scan_layer";
import type { ServerClock } from "../connection/server_clock";
import { surfacePoint } from "./surface_picker";
import type { ViewState } from "./view_state";
import { outsideView, turnControls, uprightRotation } from "./up_axis";

const VERTICAL_FOV_DEGREES = 50;
/** Duration of the motion back to the front of a surface. */
const RETURN_MILLIS = 250;
/** Closer to surfaces than this, in radii of the scene, new surroundings of the eye are needed: older ones are too coarse. */
const NEAR_SHARE = 1 / 2;
/** The same holds for this long after the eye has come closer to its target or was stopped. */
const APPROACH_MILLIS = 1000;
/** An orbit changes the distance to the target by rounding errors; an approach to less than this part of it. */
const MIN_APPROACH = 1 - 1e-6;
/** The color --ground in app.css. */
export const BACKGROUND: [number, number, number] = [0x0b / 255, 0x0e / 255, 0x13 / 255];

export class OrbitView {
  readonly occlusion = new Occlusion();
  readonly observations = new ObservationLayer(() => this.clock(), () => this.changed());
  readonly picture = new PictureLayer(this.occlusion, this.observations);
  readonly overlays = new Overlays(this.occlusion);
  readonly points = new PointsLayer(this.occlusion);
  readonly scans = new ScanLayer(this.occlusion);
  readonly frames = new FrameLayer();
  readonly robot = new RobotLayer(this.occlusion, () => this.changed());
  readonly local = new LocalModel(this.observations, () => this.changed());
  private readonly camera = new THREE.PerspectiveCamera(VERTICAL_FOV_DEGREES, 1, 0.01, 200);
  /** The picture. It is drawn first; the other objects compare their depth with the picture's in their shaders. */
  private readonly background = new THREE.Scene();
  private readonly world = new THREE.Scene();
  private readonly renderer: THREE.WebGLRenderer;
  private readonly controls: OrbitControls;
  private readonly fly: FlyControls;
  private readonly guard = new EyeGuard((from, direction, maxM) => this.local.hit(from, direction, maxM));
  /** The viewpoint after the last motion. */
  private readonly viewpoint: Viewpoint = { eye: new THREE.Vector3(), target: new THREE.Vector3() };
  private isPlacing = false;
  /** When the eye last came closer to its target, and when a surface or unknown space last stopped it. */
  private approachedAt = -Infinity;
  private stoppedAt = -Infinity;
  private returning: { from: Viewpoint; to: Viewpoint; began: number } | null = null;
  /** The part of the scene to draw. */
  readonly crop: CropBox;
  readonly measure: MeasureTool;
  /** Larger windows are rendered at this width and upscaled. */
  maxPictureWidthPx = 1280;
  private followed: THREE.Vector3 | null = null;
  private followsRobot = false;
  private scene: Scene | null = null;
  private hasUserMoved = false;
  private isStale = true;
  private isModelShown = true;
  /** Whether another direction than the server's points up. */
  private isTurned = false;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly onMove: () => void,
    private readonly clock: () => ServerClock,
  ) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    // Colors arrive as sRGB and are output unchanged.
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    THREE.ColorManagement.enabled = false;
    this.renderer.setClearColor(new THREE.Color(...BACKGROUND));
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(1, -1, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.moved());
    this.fly = new FlyControls(this.camera, this.controls.target, canvas, () => {
      this.hasUserMoved = true;
      this.moved();
    });
    this.crop = new CropBox(this.camera, canvas, () => {
      this.isStale = true;
      this.forgetSurroundings();
      onMove();
    });
    this.measure = new MeasureTool(this.camera, canvas, (x, y) => this.surfaceAt(x, y), () => this.changed());
    this.world.add(this.crop.root, this.measure.root);
    this.controls.addEventListener("start", () => (this.hasUserMoved = true));
    this.renderer.autoClear = false;
    this.background.add(this.picture.mesh, this.local.root);
    this.renderer.localClippingEnabled = true;
    const light = new THREE.DirectionalLight(0xffffff, 1.6);
    light.position.set(-0.4, 0.7, 1); // Over the viewer's left shoulder.
    this.camera.add(light);
    this.world.add(this.camera, new THREE.HemisphereLight(0xffffff, 0x5a6472, 1.7), this.overlays.root, this.robot.root);
    this.world.add(this.points.root, this.scans.root, this.frames.root);
    canvas.addEventListener("dblclick", (event) => this.pivotAt(event.offsetX, event.offsetY));
    new ResizeObserver(() => {
      this.fit();
      onMove();
    }).observe(canvas.parentElement!);
    this.fit();
  }

  /** Restores what was lost with the WebGL context, and draws again. To be called after the renderer's own listener. */
  contextRestored(): void {
    this.renderer.setClearColor(new THREE.Color(...BACKGROUND));
    this.local.contextRestored();
    this.changed();
  }

  /** Adopts a scene; the camera moves to its initial view unless the user has moved it. */
  setScene(scene: Scene): void {
    const isNew = JSON.stringify(scene) !== JSON.stringify(this.scene);
    this.scene = scene;
    if (!isNew) return;
    this.isStale = true;
    this.overlays.setScene(scene);
    this.frames.radiusM = scene.radius_m;
    this.crop.setScene(scene);
    this.camera.near = Math.max(0.005 * scene.radius_m, 0.005);
    this.camera.far = 400 * this.camera.near + 40 * scene.radius_m;
    this.camera.updateProjectionMatrix();
    this.controls.minDistance = 2 * this.camera.near;
    this.controls.maxDistance = 12 * scene.radius_m;
    this.guard.nearM = this.camera.near;
    this.fly.radiusM = scene.radius_m;
    if (!this.hasUserMoved) this.reset();
  }

  /** Returns to the scene's initial view. */
  reset(): void {
    if (!this.scene) return;
    // The server's view is upright only for its own direction of up.
    if (this.isTurned) this.jump(outsideView(this.scene, this.camera));
    else this.lookFrom(this.scene.world_from_camera);
  }

  /** Turns the view so that this direction of the world points up, and looks at the scene from outside. */
  turnUp(up: THREE.Vector3): void {
    turnControls(this.controls, up);
    this.isTurned = true;
    this.overlays.setUp(up, this.scene);
    this.hasUserMoved = true;
    this.reset();
  }

  /** Looks along a camera's axis, upright, and orbits the point on it that is closest to the scene's center. */
  lookFrom(rowMajor: number[]): void {
    const pose = worldFromCamera(rowMajor);
    const eye = new THREE.Vector3().setFromMatrixPosition(pose);
    const forward = new THREE.Vector3().setFromMatrixColumn(pose, 2);
    const center = new THREE.Vector3(...(this.scene?.center_m ?? [0, 0, 0]));
    const along = Math.max(center.sub(eye).dot(forward), 0.2 * (this.scene?.radius_m ?? 1));
    this.jump({ eye, target: eye.clone().addScaledVector(forward, along) });
  }

  /** Looks at the center of the scene from this direction. */
  lookAlong(direction: "top" | "front"): void {
    if (!this.scene) return;
    const center = new THREE.Vector3(...this.scene.center_m);
    const halfAngle = (this.camera.fov * Math.PI) / 360;
    const distance = (1.15 * this.scene.radius_m) / Math.tan(halfAngle) / Math.min(1, this.camera.aspect);
    // Almost from above: exactly from above, the direction of "up" would be undefined.
    const from = direction === "top" ? new THREE.Vector3(0, -1e-3, 1) : new THREE.Vector3(0, -1, 0);
    from.applyQuaternion(uprightRotation(this.camera.up));
    this.hasUserMoved = true;
    this.jump({ eye: center.clone().addScaledVector(from, distance), target: center });
  }

  /** Looks from a keyframe. */
  lookFromKeyframe({ world_from_camera }: PosedCamera): void {
    this.hasUserMoved = true;
    this.lookFrom(world_from_camera);
  }

  /** Turns toward a point in world, which becomes the center of the orbit. */
  turnTo(point: THREE.Vector3): void {
    this.hasUserMoved = true;
    this.jump({ eye: this.camera.position.clone(), target: point });
  }

  /** Shows a view of the camera path. */
  showPathView(view: PathView): void {
    this.fovDegrees = view.fovDegrees;
    this.hasUserMoved = true;
    this.jump({ eye: view.position, target: view.target });
  }

  /** The current view, for the camera path. */
  pathView(): PathView {
    return { position: this.camera.position, target: this.controls.target, fovDegrees: this.camera.fov };
  }

  /** The current view, so that it can be restored. */
  state(): ViewState {
    const mode = this.fly.enabled ? "fly" : this.followsRobot ? "chase" : this.hasUserMoved ? "orbit" : "overview";
    return {
      position: this.camera.position.toArray(),
      target: this.controls.target.toArray(),
      up: this.camera.up.toArray(),
      mode,
      fovDegrees: this.camera.fov,
    };
  }

  /** Returns to a view. */
  restore({ position, target, mode, fovDegrees }: ViewState): void {
    if (fovDegrees !== undefined) this.fovDegrees = fovDegrees;
    this.hasUserMoved = mode !== "overview";
    this.jump({ eye: new THREE.Vector3(...position), target: new THREE.Vector3(...target) });
  }

  /** Vertical field of view, degrees. */
  set fovDegrees(degrees: number) {
    if (degrees === this.camera.fov) return;
    this.camera.fov = degrees;
    this.camera.updateProjectionMatrix();
    this.isStale = true;
    this.onMove();
  }

  /** Whether the view flies instead of orbiting a point. */
  set flies(flies: boolean) {
    this.fly.enabled = flies;
    this.controls.enabled = !flies;
    // Both look at the target, which is where the surface is, so that an orbit begins without a jump.
    const ahead = this.surfaceAt(0.5 * this.canvas.clientWidth, 0.5 * this.canvas.clientHeight);
    const { position } = this.camera;
    const distance = ahead?.distanceTo(position) ?? this.controls.target.distanceTo(position);
    const forward = this.camera.getWorldDirection(new THREE.Vector3());
    this.controls.target.copy(position).addScaledVector(forward, Math.max(distance, this.controls.minDistance));
    this.moved();
  }

  /** Adopts newer knowledge of the model's surfaces, and returns to the front of them if the eye has passed one. */
  see(name: string, map: DepthMap): void {
    if (!this.isModelShown || this.returning) return;
    const good = this.guard.see(name, map);
    if (good) this.returning = { from: this.copyOfViewpoint(), to: good, began: performance.now() };
  }

  /** Adopts the depth of a new picture. */
  seePicture(): void {
    const { posedDepth } = this.picture;
    if (posedDepth) this.see("picture", new PictureDepthMap(posedDepth));
  }

  /** Forgets the surfaces of another model. */
  forgetSurfaces(): void {
    this.guard.forget();
  }

  /** Forgets the surroundings of the eye, because newer ones are not requested. */
  forgetSurroundings(): void {
    this.guard.forgetComplete();
  }

  /** Whether the user moves the eye in a model of which only pictures show the surfaces. */
  get usesSurroundings(): boolean {
    const isMesh = this.local.root.visible && this.local.hasDepth;
    return this.isModelShown && this.picture.posedDepth !== null && !this.followsRobot && !isMesh;
  }

  /** Whether the eye may soon be at a surface. */
  get needsSurroundings(): boolean {
    const isApproaching = performance.now() - this.approachedAt < APPROACH_MILLIS;
    const nearM = NEAR_SHARE * (this.scene?.radius_m ?? 0);
    return this.isFlyingOrStopped || isApproaching || !(this.guard.freeRadiusM(this.camera.position) > nearM);
  }

  /** Whether changes of the model matter to the motion of the eye. */
  get isFlyingOrStopped(): boolean {
    return this.fly.enabled || performance.now() - this.stoppedAt < APPROACH_MILLIS;
  }

  /** Called after each motion by the user: stops before surfaces. */
  private moved(): void {
    if (this.isPlacing) return;
    const { position } = this.camera;
    const { target } = this.controls;
    if (this.returning) {
      this.place(this.copyOfViewpoint());
      return;
    }
    if (position.equals(this.viewpoint.eye) && target.equals(this.viewpoint.target)) return;
    const isShifted = !target.equals(this.viewpoint.target);
    const allowed = this.isModelShown ? this.guard.limit(position, isShifted) : position;
    const isCloser = position.distanceTo(target) < MIN_APPROACH * this.viewpoint.eye.distanceTo(target);
    if (!isShifted && isCloser) this.approachedAt = performance.now();
    if (!allowed.equals(position)) {
      this.stoppedAt = performance.now();
      // Eye and target move together in shifts; otherwise, the eye moves around the target or toward it.
      if (isShifted) target.add(allowed).sub(position);
      position.copy(allowed);
      this.camera.lookAt(target);
      if (position.equals(this.viewpoint.eye) && target.equals(this.viewpoint.target)) return;
    }
    this.guard.moved(this.adoptViewpoint());
    this.isStale = true;
    this.onMove();
  }

  /** Looks from another place, which need not be reachable. */
  private jump(viewpoint: Viewpoint): void {
    this.returning = null;
    this.place(viewpoint);
    this.guard.jump(this.viewpoint, false);
  }

  private place({ eye, target }: Viewpoint): void {
    this.camera.position.copy(eye);
    this.controls.target.copy(target);
    this.isPlacing = true;
    this.controls.update();
    this.isPlacing = false;
    this.adoptViewpoint();
    this.isStale = true;
    this.onMove();
  }

  /** Moves back to the front of a surface, and ignores other motions meanwhile. */
  private moveBack(): void {
    if (!this.returning) return;
    const { from, to, began } = this.returning;
    const share = THREE.MathUtils.smoothstep((performance.now() - began) / RETURN_MILLIS, 0, 1);
    const between = (get: (viewpoint: Viewpoint) => THREE.Vector3): THREE.Vector3 => get(from).clone().lerp(get(to), share);
    this.place({ eye: between(({ eye }) => eye), target: between(({ target }) => target) });
    if (share < 1) return;
    this.returning = null;
    this.guard.jump(this.viewpoint, true);
  }

  private adoptViewpoint(): Viewpoint {
    this.viewpoint.eye.copy(this.camera.position);
    this.viewpoint.target.copy(this.controls.target);
    return this.viewpoint;
  }

  private copyOfViewpoint(): Viewpoint {
    return { eye: this.viewpoint.eye.clone(), target: this.viewpoint.target.clone() };
  }

  /** The point of the model's surface at a pixel of the canvas; null if there is none. */
  private surfaceAt(x: number, y: number): THREE.Vector3 | null {
    const depth = this.picture.posedDepth;
    if (!depth) return null;
    const { clientWidth, clientHeight } = this.canvas;
    const raycaster = new THREE.Raycaster();
    raycaster.setFromCamera(
      new THREE.Vector2((2 * x) / clientWidth - 1, 1 - (2 * y) / clientHeight),
      this.camera,
    );
    return surfacePoint(raycaster.ray, depth, this.camera.near, this.camera.far);
  }

  /** Turns toward the surface at a pixel of the canvas, which becomes the center of the orbit. */
  private pivotAt(x: number, y: number): void {
    const point = this.surfaceAt(x, y);
    if (!point) return;
    this.hasUserMoved = true;
    this.controls.target.copy(point);
    this.controls.update();
  }

  /** Whether the camera moves with the robot. */
  set follows(follows: boolean) {
    this.followsRobot = follows;
    this.followed = follows ? this.robot.tip : null;
  }

  /** Called when the robot has moved. */
  follow(): void {
    const tip = this.followsRobot ? this.robot.tip : null;
    if (!tip) return;
    if (this.followed && this.followed.distanceTo(tip) > 0) {
      const motion = tip.clone().sub(this.followed);
      this.camera.position.add(motion);
      this.controls.target.add(motion);
      this.hasUserMoved = true;
      this.controls.update();
    }
    this.followed = tip;
  }

  /** The current view. */
  view(): View {
    const scale = Math.min(1, this.maxPictureWidthPx / this.canvas.width);
    const size_px: [number, number] = [
      Math.max(1, Math.round(this.canvas.width * scale)),
      Math.max(1, Math.round(this.canvas.height * scale)),
    ];
    return {
      world_from_camera: poseOfThreeCamera(this.camera),
      size_px,
      projection: pinholeOfThreeCamera(this.camera, size_px),
      near_m: this.camera.near,
      far_m: this.camera.far,
      crop: this.crop.crop, // Omitted from the message if undefined.
    };
  }

  /** The current view from a place on the camera path. */
  viewAlong({ position, target, fovDegrees }: PathView, [width, height]: [number, number]): View {
    const camera = new THREE.PerspectiveCamera(fovDegrees, width / height);
    camera.up.copy(this.camera.up);
    camera.position.copy(position);
    camera.lookAt(target);
    return {
      ...this.view(),
      world_from_camera: poseOfThreeCamera(camera),
      size_px: [width, height],
      projection: pinholeOfThreeCamera(camera, [width, height]),
    };
  }

  /** Depth at which pixels without any model are placed. */
  get emptyDepth(): number {
    return 0.9 * this.camera.far;
  }

  /** Whether the model is drawn. */
  set showsModel(shown: boolean) {
    this.isModelShown = shown;
    this.changed();
  }

  /** Marks the view as changed. */
  changed(): void {
    this.isStale = true;
  }

  /** Draws only if something has changed: on a robot's computer the page shares the cores with other programs. */
  draw(): void {
    this.fly.update();
    this.moveBack();
    if (!this.isStale) return;
    this.isStale = false;
    const view = this.view();
    this.picture.setView(worldFromCamera(view.world_from_camera));
    // The server's picture stays until the first chunks have arrived.
    const isLocal = this.local.method !== null && this.local.hasChunks;
    this.picture.enabled = this.isModelShown && !isLocal;
    this.local.root.visible = this.isModelShown && isLocal;
    this.local.crop = view.crop;
    this.local.setView(view, [this.canvas.width, this.canvas.height]);
    const hasDepthBuffer = isLocal && this.local.hasDepth;
    this.occlusion.usesDepthBuffer = hasDepthBuffer;
    const needsSplatDepth = isLocal && !hasDepthBuffer && this.occlusion.enabled && this.hasOccludable;
    this.occlusion.local = needsSplatDepth ? this.splatDepth(view) : null;
    this.crop.update();
    this.measure.update();
    if (this.frames.isVisible) {
      const cameras = this.overlays.cameraPoses().map(([name, posed]) => [`camera ${name}`, posed] as const);
      this.frames.update(new Map([...this.robot.linkPoses(), ...cameras]), this.camera);
    }
    this.renderer.clear();
    this.renderer.render(this.background, this.camera);
    if (!hasDepthBuffer || !this.occlusion.enabled) this.renderer.clearDepth();
    this.renderer.render(this.world, this.camera);
  }

  /** Whether anything is drawn that the model can hide. */
  private get hasOccludable(): boolean {
    return [this.robot, this.points, this.scans, this.overlays].some((layer) => layer.isVisible);
  }

  /** Draws the depth of the splats as seen in the view; null if that is not possible. */
  private splatDepth(view: View): OcclusionDepth | null {
    const texture = this.local.drawDepth(this.renderer, this.camera, [this.canvas.width, this.canvas.height]);
    if (!texture) return null;
    return {
      texture,
      isWeighted: true,
      worldFromPicture: worldFromCamera(view.world_from_camera),
      sizePx: view.size_px,
      focalPx: view.projection.focal_px,
      principalPx: view.projection.principal_px,
    };
  }

  private fit(): void {
    const { clientWidth, clientHeight } = this.canvas.parentElement!;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / Math.max(1, clientHeight);
    this.camera.updateProjectionMatrix();
    this.isStale = true;
  }
}
