// The main view. A free camera orbits or flies. The newest picture is drawn first, and lines are
// drawn over it.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { type ArrowPlace, arrowPlace } from "./robot_arrow";
import { Attachment } from "./attachment";
import { type Block, canBeCut } from "./block";
import { worldFromCamera } from "./convention";
import type { PathView } from "./camera_path";
import { CropBox } from "./crop_box";
import { Cut } from "./cut";
import { type DepthMap, PictureDepthMap } from "../layers/depth_map";
import type { Viewpoint } from "./eye_guard";
import { EyeMotion } from "./eye_motion";
import { FlyControls } from "./fly_controls";
import { hiddenDistanceM } from "./hidden_robot";
import { FrameLayer } from "../layers/frame_layer";
import { LocalModel } from "../layers/local_model";
import { MeasureTool } from "./measure";
import { ObservationLayer } from "../layers/observation_layer";
import { Occlusion, type OcclusionDepth } from "../layers/occlusion";
import { Overlays } from "../layers/overlays";
import { PictureLayer } from "../layers/picture_layer";
import { PictureSurface } from "./picture_surface";
import { PointsLayer } from "../layers/points_layer";
import type { PosedCamera, Scene } from "../connection/protocol";
import type { View } from "../connection/render_scheduler";
import { RobotLayer } from "../layers/robot_layer";
import { ScanLayer } from "../layers/scan_layer";
import { SceneViews } from "./scene_views";
import type { ServerClock } from "../connection/server_clock";
import type { SplatEyes } from "../layers/splat_layer";
import type { EyeOptions, LentView } from "./lent_view";
import { cameraAlong, viewOfCamera } from "./view_request";
import type { ViewMode, ViewState } from "./view_state";
import { turnControls, uprightRotation } from "./up_axis";
import { listenToViewKeys } from "./view_keys";
import { viewRenderer } from "./view_renderer";
import type { ViewTool } from "./view_tool";

const VERTICAL_FOV_DEGREES = 50;
/**
 * If the eye is closer to surfaces than this, in sizes of details, new surroundings are needed,
 * because older ones are too coarse.
 */
const NEAR_SHARE = 1 / 2;
/** A cut removes the wall that has stopped the eye within this time. */
const CUT_WALL_MILLIS = 10_000;
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
  private readonly motion: EyeMotion;
  /** What the view moves with. */
  readonly attachment: Attachment;
  private readonly sceneViews: SceneViews;
  private readonly cut = new Cut();
  private readonly surface: PictureSurface;
  /** The part of the scene to draw. */
  readonly crop: CropBox;
  readonly measure: MeasureTool;
  /** Tools that other modules have added. */
  private readonly tools: ViewTool[] = [];
  /** Larger windows are rendered at this width and upscaled. */
  maxPictureWidthPx = 1280;
  /** Where to draw the arrow to the robot; null while the robot is in the picture. */
  arrow: ArrowPlace | null = null;
  /** Until the user has moved the view, it shows everything, or the first view of an older server. */
  private hasUserMoved = false;
  private hasAskedForOverview = false;
  /** Distance of the robot from the eye of the overview if the model hides it, meters; otherwise null. */
  private hiddenRobotM: number | null = null;
  /** Whether the overview cuts away surfaces that hide the robot. False after the user has shown the whole model again. */
  private mayCutForRobot = true;
  private isStale = true;
  /** Size in CSS pixels. Reading it from the canvas would lay the page out. */
  private sizePx: [number, number] = [0, 0];
  private isModelShown = true;
  /** Whether another direction than the server's points up. */
  private isTurned = false;
  /** The view of a headset that draws instead of the page; null if the page draws. */
  private headView: (() => View) | null = null;
  /** Whether a headset draws the model with pictures of its own. */
  private hasOwnPictures = false;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly onMove: () => void,
    private readonly clock: () => ServerClock,
  ) {
    this.renderer = viewRenderer(canvas);
    // Colors arrive as sRGB and are output unchanged.
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    THREE.ColorManagement.enabled = false;
    this.renderer.setClearColor(new THREE.Color(...BACKGROUND));
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(1, -1, 1);
    this.surface = new PictureSurface(this.picture, this.camera, canvas);
    this.controls = new OrbitControls(this.camera, canvas);
    listenToViewKeys(canvas, this.controls);
    this.motion = new EyeMotion(
      this.camera,
      this.controls,
      (from, direction, maxM) => this.local.hit(from, direction, maxM),
      () => this.isModelShown && !this.isCut,
      (isByUser) => this.hasMoved(isByUser),
    );
    this.sceneViews = new SceneViews(this.camera, this.robot, this.scans);
    this.attachment = new Attachment(this.camera, this.controls.target, this.motion, this.robot, this.sceneViews);
    this.fly = new FlyControls(this.camera, this.controls.target, canvas, () => this.motion.moved());
    this.crop = new CropBox(this.camera, canvas, () => {
      this.isStale = true;
      this.forgetSurroundings();
      onMove();
    });
    this.measure = new MeasureTool(this.camera, canvas, (x, y) => this.surface.at(x, y), () => this.changed());
    this.world.add(this.crop.root, this.measure.root);
    this.renderer.autoClear = false;
    this.background.add(this.picture.mesh, this.local.root);
    this.renderer.localClippingEnabled = true;
    const light = new THREE.DirectionalLight(0xffffff, 1.6);
    light.position.set(-0.4, 0.7, 1); // Over the viewer's left shoulder.
    this.camera.add(light);
    this.world.add(this.camera, new THREE.HemisphereLight(0xffffff, 0x5a6472, 1.7), this.overlays.root, this.robot.root);
    this.world.add(this.points.root, this.scans.root, this.frames.root);
    canvas.addEventListener("dblclick", (event) => !this.isToolInUse && this.pivotAt(event.offsetX, event.offsetY));
    new ResizeObserver(() => {
      this.fit();
      onMove();
    }).observe(canvas.parentElement!);
    this.fit();
  }

  /** Adds a tool that uses the camera of the view. */
  addTool<T extends ViewTool>(create: (camera: THREE.PerspectiveCamera) => T): T {
    const tool = create(this.camera);
    this.tools.push(tool);
    this.world.add(tool.root);
    return tool;
  }

  /** Restores what was lost with the WebGL context, and draws again. To be called after the renderer's own listener. */
  contextRestored(): void {
    this.renderer.setClearColor(new THREE.Color(...BACKGROUND));
    this.local.contextRestored();
    this.changed();
  }

  /** Adopts a scene. Until the user moves the view, it shows everything, or the first view of an older server. */
  setScene(scene: Scene): void {
    const isNew = JSON.stringify(scene) !== JSON.stringify(this.scene);
    this.sceneViews.scene = scene;
    if (!isNew) return;
    this.isStale = true;
    this.overlays.setScene(scene);
    const { detailM } = this.sceneViews;
    this.frames.radiusM = detailM;
    this.crop.setScene(scene);
    this.camera.near = Math.max(0.005 * detailM, 0.005);
    this.camera.far = 400 * this.camera.near + 40 * scene.radius_m;
    this.camera.updateProjectionMatrix();
    this.controls.minDistance = 2 * this.camera.near;
    this.controls.maxDistance = 12 * scene.radius_m;
    this.motion.nearM = this.camera.near;
    this.fly.radiusM = detailM;
    if (!this.hasUserMoved && !this.keepsOverview) this.lookFrom(scene.world_from_camera);
  }

  private get scene(): Scene | null {
    return this.sceneViews.scene;
  }

  /** Shows everything at once: the scene, the robot and its path. The view stays so until the user moves it. */
  showOverview(): void {
    this.attachment.end();
    this.hasUserMoved = false;
    this.hasAskedForOverview = true;
    this.mayCutForRobot = true;
    this.sceneViews.restartOverview();
    this.keepOverview();
  }

  /** Moves the view to the overview if that has begun, or no longer shows everything. */
  private keepOverview(): void {
    const overview = this.keepsOverview ? this.sceneViews.overview() : null;
    if (overview) this.motion.jump(overview);
  }

  /** Whether the view shows everything until the user moves it. */
  private get keepsOverview(): boolean {
    return !this.hasUserMoved && (this.hasAskedForOverview || this.scene?.bounds !== undefined);
  }

  /** Returns to the view of the first camera. */
  reset(): void {
    if (!this.scene) return;
    // The server's view is upright only for its own direction of up.
    if (this.isTurned) {
      this.showOverview();
      return;
    }
    this.hasUserMoved = true;
    this.lookFrom(this.scene.world_from_camera);
  }

  /** Turns the view so that this direction of the world points up, and shows everything. */
  turnUp(up: THREE.Vector3): void {
    turnControls(this.controls, up);
    this.isTurned = up.distanceTo(new THREE.Vector3(0, 0, 1)) > 1e-6;
    this.overlays.setUp(up, this.scene);
    this.showOverview();
  }

  /** Looks along a camera's axis, upright, and orbits the point on it that is closest to the scene's center. */
  lookFrom(rowMajor: number[]): void {
    const pose = worldFromCamera(rowMajor);
    const eye = new THREE.Vector3().setFromMatrixPosition(pose);
    const forward = new THREE.Vector3().setFromMatrixColumn(pose, 2);
    this.jump({ eye, target: eye.clone().addScaledVector(forward, this.sceneViews.distanceAhead(eye, forward)) });
  }

  /** Looks at everything from above, or from the front of the robot. */
  lookAlong(direction: "top" | "front"): void {
    const view = this.sceneViews.along(direction);
    if (!view) return;
    this.hasUserMoved = true;
    this.jump(view);
  }

  /** Looks from another place, which need not be reachable. A view that follows the robot continues from there. */
  private jump(viewpoint: Viewpoint): void {
    this.attachment.endRide();
    this.motion.jump(viewpoint);
  }

  /** Looks from a keyframe. */
  lookFromKeyframe({ world_from_camera }: PosedCamera): void {
    this.hasUserMoved = true;
    this.lookFrom(world_from_camera);
  }

  /** Looks at a point in world, which becomes the center of the orbit, from another place or from the present one. */
  lookAt(point: THREE.Vector3, eye: THREE.Vector3 | null): void {
    if (eye && this.isCut) this.isCut = false; // It was for the present place.
    this.hasUserMoved = true;
    this.jump({ eye: eye ?? this.camera.position.clone(), target: point });
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

  /** How the view moves. */
  get mode(): ViewMode {
    if (this.fly.enabled) return "fly";
    if (this.attachment.riddenCamera !== null) return "ride";
    if (this.attachment.isChasing) return "chase";
    return this.hasUserMoved ? "orbit" : "overview";
  }

  /** The current view, so that it can be restored. */
  state(): ViewState {
    const { mode } = this;
    const state: ViewState = {
      position: this.camera.position.toArray(),
      target: this.controls.target.toArray(),
      up: new THREE.Vector3(0, 1, 0).applyQuaternion(this.camera.quaternion).toArray(),
      mode,
      fovDegrees: this.attachment.fovDegrees,
    };
    const attachedTo = mode === "ride" ? this.attachment.riddenCamera : mode === "chase" ? this.attachment.frame : null;
    return attachedTo === null ? state : { ...state, attachedTo };
  }

  /** Returns to a view. A ride begins once the pose of its camera is known. All other views are upright. */
  restore({ position, target, mode, fovDegrees, attachedTo }: ViewState): void {
    this.attachment.end();
    if (this.isCut) this.isCut = false; // It depends on the view.
    this.flies = mode === "fly";
    if (fovDegrees !== undefined) this.fovDegrees = fovDegrees;
    this.jump({ eye: new THREE.Vector3(...position), target: new THREE.Vector3(...target) });
    if (mode === "chase") this.attachment.startChase(true);
    if (mode === "chase" && attachedTo !== undefined) this.attachment.frame = attachedTo;
    if (mode === "ride" && attachedTo !== undefined) this.attachment.startRide(attachedTo);
    this.hasUserMoved = mode !== "overview";
  }

  /** Vertical field of view, degrees. */
  set fovDegrees(degrees: number) {
    if (degrees === this.camera.fov) return;
    this.attachment.endRide();
    this.camera.fov = degrees;
    this.camera.updateProjectionMatrix();
    this.sceneViews.refitOverview();
    this.isStale = true;
    this.onMove();
  }

  /** Whether the view flies instead of orbiting a point. */
  set flies(flies: boolean) {
    if (flies === this.fly.enabled) return;
    if (flies) this.attachment.end();
    this.fly.enabled = flies;
    this.controls.enabled = !flies;
    // When flying begins or ends, the target is placed on the surface ahead, so that an orbit
    // begins without a jump.
    const ahead = this.surface.ahead();
    const { position } = this.camera;
    const distance = ahead?.distanceTo(position) ?? this.controls.target.distanceTo(position);
    const forward = this.camera.getWorldDirection(new THREE.Vector3());
    this.controls.target.copy(position).addScaledVector(forward, Math.max(distance, this.controls.minDistance));
    this.motion.moved();
  }

  /** Adopts newer knowledge of the model's surfaces, and returns to the front of them if the eye has passed one. */
  see(name: string, map: DepthMap): void {
    if (!this.headView) this.motion.see(name, map);
  }

  /** Adopts the depth of a new picture. */
  seePicture(): void {
    const { posedDepth } = this.picture;
    if (posedDepth) this.see("picture", new PictureDepthMap(posedDepth));
    this.hiddenRobotM = this.mode === "overview" ? this.robotBehindModel() : null;
    if (this.hiddenRobotM !== null && this.mayCutForRobot) this.isCut = true;
  }

  /** Distance of the robot if the model hides it; otherwise null. */
  private robotBehindModel(): number | null {
    if (!this.isModelShown || !this.occlusion.enabled || this.isCut) return null;
    return hiddenDistanceM(this.sceneViews.robotBox(), this.camera.position, (point) => this.surface.toward(point));
  }

  /** Forgets the surfaces of another model. */
  forgetSurfaces(): void {
    this.motion.forgetSurfaces();
  }

  /** Forgets the surroundings of the eye, because newer ones are not requested. */
  forgetSurroundings(): void {
    this.motion.forgetSurroundings();
  }

  /** Whether the user moves the eye in a model of which only pictures show the surfaces. */
  get usesSurroundings(): boolean {
    const isMesh = this.local.root.visible && this.local.hasDepth;
    const isSolid = this.isModelShown && !this.isCut && !this.headView;
    return isSolid && this.picture.posedDepth !== null && !this.attachment.isOn && !isMesh;
  }

  /** Whether the eye may soon be at a surface. */
  get needsSurroundings(): boolean {
    const isNear = !(this.motion.freeRadiusM > NEAR_SHARE * this.sceneViews.detailM);
    return this.isFlyingOrStopped || this.motion.isApproaching || isNear;
  }

  /** Whether changes of the model matter to the motion of the eye. */
  get isFlyingOrStopped(): boolean {
    return this.fly.enabled || this.motion.wasStopped;
  }

  private hasMoved(isByUser: boolean): void {
    if (isByUser) {
      this.hasUserMoved = true;
      this.attachment.endRide();
    }
    this.isStale = true;
    this.onMove();
  }

  /** What stopped the eye last or hides the robot, and when; null if there is nothing. */
  get block(): { what: Block; at: number } | null {
    const isHidden = this.hiddenRobotM !== null && this.mode === "overview" && !this.isCut;
    return isHidden ? { what: { by: "model before robot" }, at: performance.now() } : this.motion.block;
  }

  private get targetDistanceM(): number {
    return this.camera.position.distanceTo(this.controls.target);
  }

  /** Whether the part of the model between eye and target is cut away. Surfaces do not stop the eye then. */
  get isCut(): boolean {
    return this.cut.isOn;
  }

  set isCut(isCut: boolean) {
    const { block } = this;
    const isAtWall = block !== null && canBeCut(block.what) && performance.now() - block.at < CUT_WALL_MILLIS;
    const distanceM = this.targetDistanceM;
    const robotM = isAtWall ? this.hiddenRobotM : this.robotBehindModel();
    if (!isCut) {
      this.cut.end();
      this.mayCutForRobot = false;
    } else if (robotM !== null) this.cut.beginAt(robotM, distanceM);
    else this.cut.begin(distanceM, this.sceneViews.radiusM, isAtWall);
    this.hiddenRobotM = null;
    this.motion.forgetPlaces();
    this.isStale = true;
    this.onMove();
  }

  /** Turns toward the surface at a pixel of the canvas, which becomes the center of the orbit. */
  private pivotAt(x: number, y: number): void {
    const point = this.surface.at(x, y);
    if (!point) return;
    this.hasUserMoved = true;
    this.controls.target.copy(point);
    this.controls.update();
  }

  /** Attaches the view to a camera until the user moves it. */
  ride(camera: string): void {
    this.flies = false;
    if (this.isCut) this.isCut = false; // The camera sees what is in front of it.
    this.hasUserMoved = true;
    this.attachment.startRide(camera);
  }

  /** Whether clicks on the view belong to a tool: to the measurement, to a handle of the box, or to another tool. */
  get isToolInUse(): boolean {
    return this.measure.enabled || this.crop.hasTakenPress || this.tools.some((tool) => tool.hasTakenPress);
  }

  /** Whether the view moves with the robot. */
  set follows(follows: boolean) {
    this.flies = false;
    if (!follows) this.attachment.end();
    else this.attachment.startChase(this.arrow === null);
    this.hasUserMoved = true;
  }

  /** The current view: that of the page, or of the headset that draws instead of the page. */
  view(): View {
    if (this.headView) return this.headView();
    const scale = Math.min(1, this.maxPictureWidthPx / this.canvas.width);
    const size_px: [number, number] = [
      Math.max(1, Math.round(this.canvas.width * scale)),
      Math.max(1, Math.round(this.canvas.height * scale)),
    ];
    return viewOfCamera(this.camera, size_px, this.cut.depthM(this.targetDistanceM, this.camera.near), this.crop.crop);
  }

  /** The current view from a place on the camera path. */
  viewAlong(along: PathView, sizePx: [number, number]): View {
    const nearM = this.cut.depthM(along.position.distanceTo(along.target), this.camera.near);
    return viewOfCamera(cameraAlong(along, sizePx, this.camera), sizePx, nearM, this.crop.crop);
  }

  /** Depth at which pixels without any model are placed. */
  get emptyDepth(): number {
    return 0.9 * this.camera.far;
  }

  /** Whether the server's pictures are not needed for the current view. */
  get replacesPictures(): boolean {
    return this.local.replacesPictures || this.hasOwnPictures;
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

  /**
   * Draws only if something has changed, because the page shares the cores of a robot's computer
   * with other programs.
   */
  draw(): void {
    if (this.headView) return;
    this.fly.update();
    this.motion.moveBack();
    this.attachment.update();
    this.keepOverview();
    if (!this.isStale) return;
    this.isStale = false;
    const view = this.view();
    this.picture.setView(worldFromCamera(view.world_from_camera));
    this.local.root.visible = this.isModelShown;
    this.local.crop = view.crop;
    // The server's picture stays until the chunks in view have arrived.
    this.local.setView(view, [this.canvas.width, this.canvas.height], this.picture.showsView);
    const isLocal = this.local.isShown;
    this.picture.enabled = this.isModelShown && !isLocal;
    this.local.root.visible = this.isModelShown && isLocal;
    const hasDepthBuffer = isLocal && this.local.hasDepth;
    this.occlusion.usesDepthBuffer = hasDepthBuffer;
    const needsSplatDepth = isLocal && !hasDepthBuffer && this.occlusion.enabled && this.hasOccludable;
    this.occlusion.local = needsSplatDepth ? this.splatDepth(view) : null;
    this.crop.update();
    this.measure.update();
    for (const tool of this.tools) tool.update();
    this.robot.fadeNear(this.camera.position);
    this.arrow = arrowPlace(this.sceneViews.robotBox(), this.camera, this.sizePx);
    if (this.frames.isVisible) this.updateFrames();
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

  /** Lends everything that is drawn to a headset, whose view replaces that of the page. */
  lend(headView: () => View): LentView {
    const roots = this.lentRoots;
    const parents = roots.map(({ parent }) => parent!);
    const worldFromCamera = this.view().world_from_camera;
    this.headView = headView;
    this.overlays.writesDepth = true;
    return {
      renderer: this.renderer,
      roots,
      worldFromCamera,
      scene: this.scene,
      worldFromUpright: uprightRotation(this.controls.object.up),
      background: new THREE.Color(...BACKGROUND),
      crop: this.crop,
      robot: this.robot,
      overlays: this.overlays,
      canDrawModel: () => this.local.isShown,
      showsModel: () => this.isModelShown,
      prepare: (view, eyes, options) => this.prepareEyes(view, eyes, options),
      end: () => {
        this.headView = null;
        this.hasOwnPictures = false;
        this.picture.hidesEmpty = false;
        this.overlays.writesDepth = false;
        for (const [ix, root] of roots.entries()) parents[ix]!.add(root);
        this.fit();
        this.onMove();
      },
    };
  }

  private get lentRoots(): THREE.Object3D[] {
    const layers = [this.overlays, this.robot, this.points, this.scans, this.frames, this.crop, ...this.tools];
    return [this.local.root, this.picture.mesh, ...layers.map(({ root }) => root)];
  }

  private prepareEyes(view: View, eyes: SplatEyes, options: EyeOptions): ReturnType<LentView["prepare"]> {
    this.hasOwnPictures = options.hasOwnPictures;
    this.picture.hidesEmpty = options.hasPassthrough;
    const head = worldFromCamera(view.world_from_camera);
    this.picture.setView(head);
    this.local.root.visible = this.isModelShown;
    this.local.crop = view.crop;
    this.local.setView(view, view.size_px, false, eyes);
    const isLocal = this.local.isShown && !options.hasOwnPictures;
    this.local.root.visible = this.isModelShown && isLocal;
    this.picture.enabled = this.isModelShown && !isLocal && !options.hasOwnPictures;
    // The depth buffer holds the model, so that it and all bodies hide each other.
    this.occlusion.usesDepthBuffer = true;
    this.occlusion.local = null;
    this.robot.fadeNear(new THREE.Vector3().setFromMatrixPosition(head));
    if (this.frames.isVisible) this.updateFrames();
    return this.local.root.visible ? "local" : this.picture.mesh.visible ? "pictures" : "nothing";
  }

  private updateFrames(): void {
    const cameras = this.overlays.cameraPoses().map(([name, posed]) => [`camera ${name}`, posed] as const);
    this.frames.update(new Map([...this.robot.linkPoses(), ...cameras]), this.camera);
  }

  private fit(): void {
    if (this.headView) return; // The renderer has the size of the headset.
    const { clientWidth, clientHeight } = this.canvas.parentElement!;
    this.sizePx = [clientWidth, clientHeight];
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / Math.max(1, clientHeight);
    this.camera.updateProjectionMatrix();
    this.sceneViews.refitOverview();
    this.isStale = true;
  }
}
