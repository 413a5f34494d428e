// A session in a headset: draws what the page shows for both eyes, follows the hands, and ends with everything as it was.

import * as THREE from "three";
import type { PosedCamera } from "../connection/protocol";
import type { View } from "../connection/render_scheduler";
import type { SplatEyes } from "../layers/splat_layer";
import type { HandSteering } from "../steering/hand_steering";
import { cameraOfThree, rowMajorPose, worldFromThreeCamera } from "../view/convention";
import type { LentView } from "../view/lent_view";
import type { OrbitView } from "../view/orbit_view";
import { Sign, Vignette } from "./comfort";
import { type EyeLens, lensAround, lensOfProjection } from "./eye_lens";
import { Governor } from "./governor";
import { type Hand, HandInput, type Side } from "./hand_input";
import { HandSteer } from "./hand_steer";
import { CHOICES, menuContent, type MenuState, pressPageButton, type Tab } from "./headset_menu";
import { ImagePanels } from "./image_panels";
import { otherSide, PalmMenu } from "./palm_menu";
import {
  atFullSize,
  headYawRad,
  moved,
  onFloor,
  onTable,
  type Placement,
  type SceneExtent,
  teleported,
  worldFromHeadset,
} from "./placement";
import { Pointers } from "./pointers";
import { HANDHELD_LIMITS, RefreshRule } from "./refresh_rule";
import { type Holder, SceneGrab } from "./scene_grab";
import { EyePictures, HandPicture, type ServerPictureParts, SpherePicture } from "./server_pictures";
import { StickMotion } from "./stick_motion";

/** Near and far plane, meters of the room. */
const NEAR_M = 0.04;
const FAR_M = 400;
/** Pixels per unit of the tangent of the head's view, for which the server chooses what it sends first. */
const VIEW_PX_PER_TANGENT = 200;
/** The head may move by this much before the splats are sorted again, meters of the room. */
const SORT_TOLERANCE_M = 0.004;
/** The menu shows texts that change this often. */
const MENU_MILLIS = 200;
const HEIGHT_STEP_M = 0.1;
/** Farthest place of a jump, meters of the room. */
const JUMP_M = 12;
/** Scenes smaller than this are on a table, whose height is below, meters. */
const SMALL_SCENE_M = 1.2;
const TABLE_M = 0.75;
/** Frame rate of headsets that do not report theirs. */
const DEFAULT_HZ = 72;

/** What the headset uses of the page. */
export interface HeadsetParts {
  view: OrbitView;
  /** Does what the page does for each display refresh before it draws. */
  prepareFrame(): void;
  /** The view has changed so much that the server should know. */
  moved(): void;
  posedImages(): readonly PosedCamera[];
  /** How the robot is steered; null if it cannot be. */
  steering(): HandSteering | null;
  pictures: ServerPictureParts;
}

export class Headset {
  constructor(private readonly parts: HeadsetParts) {}

  /** Shows the scene in a session until its end. */
  async run(session: XRSession, mode: "immersive-vr" | "immersive-ar"): Promise<void> {
    // After the listeners of three.js, which give the size of the canvas back.
    const ended = new Promise<void>((done) => session.addEventListener("end", () => setTimeout(done)));
    const inside = new InsideHeadset(this.parts, session, mode === "immersive-ar");
    try {
      await inside.begin();
      await ended;
    } finally {
      inside.end();
    }
  }
}

class InsideHeadset {
  private readonly lent: LentView;
  private readonly scene = new THREE.Scene();
  /** Carries the camera from the space of the headset to the world. */
  private readonly rig = new THREE.Group();
  private readonly camera = new THREE.PerspectiveCamera(90, 1, NEAR_M, FAR_M);
  /** Always in front of the eyes. */
  private readonly head = new THREE.Group();
  private readonly menu = new PalmMenu();
  private readonly vignette = new Vignette();
  private readonly sign = new Sign();
  private readonly images = new ImagePanels();
  private readonly pointers = new Pointers();
  private readonly input: HandInput;
  private readonly grab = new SceneGrab();
  private readonly sticks = new StickMotion();
  private readonly steer: HandSteer;
  private readonly governor: Governor;
  private readonly eyePictures: EyePictures;
  private readonly handPicture: HandPicture;
  private readonly sphere: SpherePicture;
  private readonly viewRule = new RefreshRule(HANDHELD_LIMITS);
  private readonly state: MenuState;
  private placement: Placement = { origin: new THREE.Vector3(), yawRad: 0, scale: 1 };
  private preset: "table" | "full" | "robot";
  /** The scene has no place until the first pose of the head is known. */
  private isPlaced = false;
  private space: XRReferenceSpace | null = null;
  private headView: View;
  /** The largest viewport of each eye so far: that at the full viewport scale. */
  private readonly fullSizes = new Map<number, [number, number]>();
  private eyeLenses: EyeLens[] = [];
  private lastMillis: number | null = null;
  private menuShownAt = -Infinity;
  /** Whether the page drew the model itself before the session, and whether the session has changed that. */
  private wasLocal = false;
  private hasSwitchedToLocal = false;
  private hasClosed = false;
  private nFrames = 0;
  /** What the pictures of the server show, as text. */
  private picturesOf = "";
  private goSide: Side | null = null;

  constructor(
    private readonly parts: HeadsetParts,
    private readonly session: XRSession,
    private readonly hasPassthrough: boolean,
  ) {
    this.headView = parts.view.view();
    this.lent = parts.view.lend(() => this.headView);
    this.governor = new Governor(session.frameRate ?? DEFAULT_HZ);
    this.preset = hasPassthrough ? "table" : "full";
    this.state = {
      tab: "view",
      quality: this.governor.quality,
      fixedQuality: null,
      hasVignette: true,
      isLeftHanded: false,
      isPinned: false,
      showsImages: true,
      movesBox: false,
      steersByHand: false,
      placesGoal: false,
      drawnBy: "nothing",
      hasHandPicture: false,
      hasSphere: false,
    };
    this.input = new HandInput(session, (side) => this.triggerBegins(side));
    this.steer = new HandSteer(() => parts.steering());
    this.eyePictures = new EyePictures(parts.pictures);
    this.handPicture = new HandPicture(parts.pictures);
    this.sphere = new SpherePicture(parts.pictures);
    this.build();
    session.addEventListener("visibilitychange", () => {
      if (session.visibilityState !== "visible") this.letGo("the headset was taken off, or shows its own menu");
    });
  }

  private build(): void {
    const light = new THREE.DirectionalLight(0xffffff, 1.6);
    light.position.set(-0.4, 0.7, 1);
    this.head.add(light, this.vignette.mesh, this.sign.mesh);
    this.rig.add(this.camera, this.head, this.menu.root, this.images.besideOperator, this.pointers.root);
    this.rig.matrixAutoUpdate = false;
    this.head.matrixAutoUpdate = false;
    this.rig.add(this.handPicture.picture.mesh);
    this.scene.add(this.eyePictures.root, this.sphere.mesh);
    this.scene.add(this.rig, new THREE.HemisphereLight(0xffffff, 0x5a6472, 1.7), this.images.inScene, ...this.lent.roots);
    // Lights point at their target, which is at the origin of the world unless it moves along.
    this.head.add(light.target);
  }

  /** Takes over the renderer. */
  async begin(): Promise<void> {
    const { renderer } = this.lent;
    const { xr } = renderer;
    renderer.autoClear = true;
    xr.enabled = true;
    xr.setReferenceSpaceType("local-floor");
    xr.setFramebufferScaleFactor(Number((document.getElementById("headset-scale") as HTMLSelectElement | null)?.value ?? 1));
    xr.setAnimationLoop((time, frame) => this.frame(time, frame));
    await xr.setSession(this.session);
    this.space = xr.getReferenceSpace();
    this.space?.addEventListener("reset", (event) => this.recentered(event));
    document.documentElement.dataset.headset = this.hasPassthrough ? "passthrough" : "immersive";
    Object.assign(globalThis, { fieldrigHeadset: () => this.report() });
  }

  /**
   * Makes the page draw the model itself as soon as it can, because pictures of the server follow the head too slowly. The
   * model may begin to exist during the session.
   */
  private drawLocally(): void {
    const local = document.getElementById("toggle-local");
    if (this.hasSwitchedToLocal || !local || local.hidden) return;
    this.hasSwitchedToLocal = true;
    this.wasLocal = local.getAttribute("aria-pressed") === "true";
    if (!this.wasLocal) local.click();
  }

  /** Gives everything back. */
  end(): void {
    if (this.hasClosed) return;
    this.hasClosed = true;
    this.letGo("the headset was left");
    const { renderer } = this.lent;
    renderer.xr.setAnimationLoop(null);
    renderer.xr.enabled = false;
    renderer.autoClear = false;
    renderer.setAnimationLoop(null);
    for (const part of [this.menu, this.vignette, this.sign, this.images, this.pointers, this.steer, this.eyePictures, this.handPicture, this.sphere]) {
      part.dispose();
    }
    const local = document.getElementById("toggle-local");
    const isLocal = local?.getAttribute("aria-pressed") === "true";
    if (local && !local.hidden && this.hasSwitchedToLocal && isLocal !== this.wasLocal) local.click();
    delete document.documentElement.dataset.headset;
    this.lent.end();
  }

  /** Opens the clutch and lets go of the scene. */
  private letGo(reason: string): void {
    this.steer.interrupt(reason);
    this.grab.release();
    this.input.release();
    this.goSide = null;
  }

  /** The origin of the headset's space has moved. The scene stays where it is in the room if the headset reports how. */
  private recentered({ transform }: XRReferenceSpaceEvent): void {
    this.letGo("the headset was recentered");
    if (!transform) {
      this.isPlaced = false;
      return;
    }
    const oldFromNew = new THREE.Matrix4().fromArray(transform.matrix);
    const worldFromNew = worldFromHeadset(this.placement, new THREE.Quaternion()).multiply(oldFromNew);
    const origin = new THREE.Vector3().setFromMatrixPosition(worldFromNew);
    this.placement = { ...this.placement, origin, yawRad: this.placement.yawRad + headYawRad(oldFromNew) };
  }

  private frame(time: number, frame: XRFrame): void {
    const secs = this.lastMillis === null ? 0 : Math.max(0, (time - this.lastMillis) / 1000);
    this.lastMillis = time;
    this.drawLocally();
    this.parts.prepareFrame();
    const pose = this.space && frame.getViewerPose(this.space);
    if (!this.space || !pose) {
      this.letGo("tracking of the headset was lost");
      return;
    }
    const headsetFromHead = new THREE.Matrix4().fromArray(pose.transform.matrix);
    if (!this.isPlaced) this.place(this.preset, headsetFromHead);
    this.input.read(frame, this.space);
    this.followHands(headsetFromHead, secs);
    this.head.matrix.copy(headsetFromHead);
    this.rig.matrix.copy(this.worldFromHeadset);
    this.rig.updateMatrixWorld(true);
    this.readEyes(pose);
    this.updateHeadView(headsetFromHead, time);
    this.govern(pose, time);
    this.images.inScene.visible = this.state.showsImages;
    this.images.besideOperator.visible = this.state.showsImages;
    this.images.update(this.parts.posedImages(), this.lent.overlays.liveFrustumDepthM, time);
    this.showSign();
    this.drawModel(headsetFromHead, time);
    this.lent.renderer.render(this.scene, this.camera);
    this.nFrames += 1;
  }

  /** Prepares what draws the model: the page or, where that is too slow or impossible, pictures for the eyes. */
  private drawModel(headsetFromHead: THREE.Matrix4, nowMillis: number): void {
    const { lent, state, headView, hasPassthrough } = this;
    const frame = { nowMillis, worldFromHeadset: this.worldFromHeadset, scale: this.placement.scale, headView, hasPassthrough };
    const shown = JSON.stringify([this.parts.pictures.request(headView).method, headView.crop, this.placement.scale]);
    if (shown !== this.picturesOf) {
      this.picturesOf = shown;
      for (const pictures of [this.eyePictures, this.handPicture, this.sphere]) pictures.forget();
    }
    this.handPicture.update(frame, state.hasHandPicture ? this.input.hand(otherSide(this.menuSide)) : null);
    this.sphere.update(frame, state.hasSphere);
    const needsPictures = (this.governor.quality.usesServer || !lent.canDrawModel()) && lent.showsModel() && !state.hasSphere;
    if (needsPictures) this.eyePictures.update(frame, lent.renderer.xr.getCamera().cameras, this.eyeLenses);
    const hasEyes = needsPictures && this.eyePictures.isReady;
    this.eyePictures.root.visible = hasEyes;
    const hasOwnPictures = hasEyes || this.sphere.mesh.visible;
    const drawnBy = lent.prepare(headView, this.splatEyes(headsetFromHead), { hasOwnPictures, hasPassthrough });
    state.drawnBy = hasEyes ? "eyes" : drawnBy;
  }

  private get worldFromHeadset(): THREE.Matrix4 {
    return worldFromHeadset(this.placement, this.lent.worldFromUpright);
  }

  // Where the scene is.

  private place(preset: typeof this.preset, headsetFromHead: THREE.Matrix4): void {
    this.preset = preset;
    this.isPlaced = true;
    const extent = this.extent();
    const uprightFromWorld = this.lent.worldFromUpright.clone().invert();
    const eye = worldFromThreeCamera(this.lent.worldFromCamera).premultiply(new THREE.Matrix4().makeRotationFromQuaternion(uprightFromWorld));
    const viewYaw = floorYawRad(eye);
    if (preset === "table") {
      this.placement = onTable(extent, headsetFromHead, viewYaw);
    } else {
      // The base of an arm is as high as a table.
      const floorM = extent.floorM - (extent.radiusM < SMALL_SCENE_M ? TABLE_M : 0);
      const base = this.lent.robot.namedLinks && this.lent.robot.linkPose(this.lent.robot.namedLinks.base);
      const at = preset === "robot" && base ? base.clone().premultiply(new THREE.Matrix4().makeRotationFromQuaternion(uprightFromWorld)) : null;
      const place = new THREE.Vector3().setFromMatrixPosition(at ?? eye);
      // Behind the base, looking along its x axis.
      const yaw = at ? Math.atan2(at.elements[1]!, at.elements[0]!) - Math.PI / 2 : viewYaw;
      if (at) place.addScaledVector(new THREE.Vector3(Math.sin(yaw), -Math.cos(yaw), 0), 0.8);
      this.placement = atFullSize(place, yaw, floorM, headsetFromHead);
    }
    const head = new THREE.Vector3().setFromMatrixPosition(headsetFromHead);
    this.images.placeAround(head, headYawRad(headsetFromHead));
    this.steer.interrupt("the scene was placed");
  }

  private extent(): SceneExtent {
    const { scene } = this.lent;
    const uprightFromWorld = this.lent.worldFromUpright.clone().invert();
    const corners = scene?.bounds
      ? [scene.bounds.min_m, scene.bounds.max_m]
      : [(scene?.center_m ?? [0, 0, 0]).map((value) => value - 0.5 * (scene?.radius_m ?? 1)), scene?.center_m ?? [0, 0, 0]];
    const heights = corners.map((corner) => new THREE.Vector3(...(corner as [number, number, number])).applyQuaternion(uprightFromWorld).z);
    const center = new THREE.Vector3(...(scene?.center_m ?? [0, 0, 0])).applyQuaternion(uprightFromWorld);
    return { center, radiusM: scene?.radius_m ?? 1, floorM: Math.min(...heights) };
  }

  // What the hands do.

  private get menuSide(): Side {
    return this.state.isLeftHanded ? "right" : "left";
  }

  private followHands(headsetFromHead: THREE.Matrix4, secs: number): void {
    const headAt = new THREE.Vector3().setFromMatrixPosition(headsetFromHead);
    const pointing = this.input.hand(otherSide(this.menuSide));
    const holding = this.input.hand(this.menuSide);
    this.menu.isPinned = this.state.isPinned;
    this.menu.follow(holding, headAt);
    const hit = pointing && this.menu.hit(pointing.ray);
    this.menu.hover = hit?.button?.id ?? null;
    this.showMenu();
    if (this.goSide && !this.input.hand(this.goSide)?.isTrigger) this.releaseGo();

    const before = this.placement;
    this.followGrab(pointing, holding, hit !== null);
    const isOnMenu = hit !== null;
    const isAimingAt = this.followSticks(headsetFromHead, pointing, secs);
    if (this.placement !== before) this.steer.interrupt("the scene was moved");
    this.steer.update(pointing, this.worldFromHeadset, this.state.steersByHand && !isOnMenu && this.goSide === null);
    this.followGoal(pointing, isOnMenu);
    this.pointers.update([pointing, holding], hit?.distance ?? null, isAimingAt);
  }

  /** Hands that squeeze, or bare hands that pinch, hold the scene or the box. */
  private followGrab(pointing: Hand | null, holding: Hand | null, isOnMenu: boolean): void {
    const isTool = this.state.steersByHand || this.state.placesGoal || this.goSide !== null;
    const holder = (hand: Hand | null, isBusy: boolean): Holder | null =>
      hand && {
        position: new THREE.Vector3().setFromMatrixPosition(hand.grip),
        isHolding: hand.isSqueeze || (hand.isBare && hand.isTrigger && !isBusy),
      };
    const [mine, other] = [holder(pointing, isTool || isOnMenu), holder(holding, this.menu.isVisible)];
    const [left, right] = this.menuSide === "left" ? [other, mine] : [mine, other];
    if (!this.state.movesBox) {
      this.placement = this.grab.update(this.placement, left, right);
      return;
    }
    // The box moves as the scene would move if it were held: the motion of the hands in the world.
    const after = this.grab.update(this.placement, left, right);
    if (after !== this.placement) this.moveBox(this.placement, after);
  }

  private moveBox(before: Placement, after: Placement): void {
    const { center, size, yaw } = this.lent.crop.pose;
    const nowFromBefore = worldFromHeadset(before, this.lent.worldFromUpright).multiply(
      worldFromHeadset(after, this.lent.worldFromUpright).invert(),
    );
    const scale = before.scale / after.scale;
    this.lent.crop.setPose(center.clone().applyMatrix4(nowFromBefore), size.clone().multiplyScalar(scale), yaw + before.yawRad - after.yawRad);
  }

  /** Glides, turns and jumps. Returns where a jump would lead, in the headset's space. */
  private followSticks(headsetFromHead: THREE.Matrix4, pointing: Hand | null, secs: number): THREE.Vector3 | null {
    const still: [number, number] = [0, 0];
    const glide = this.input.hand(this.menuSide)?.stick ?? still;
    const result = this.sticks.update(this.placement, glide, pointing?.stick ?? still, headsetFromHead, secs);
    this.placement = result.placement;
    this.vignette.update(this.state.hasVignette && result.isMoving, secs);
    if (!pointing || !(result.isAiming || result.jumps)) return null;
    const floorM = this.extent().floorM;
    const { from, direction } = pointing.ray;
    const target = onFloor(this.placement, from, direction, floorM, JUMP_M);
    if (target && result.jumps) {
      this.placement = teleported(this.placement, target, new THREE.Vector3().setFromMatrixPosition(headsetFromHead));
      return null;
    }
    const headsetFromUpright = worldFromHeadset(this.placement, new THREE.Quaternion()).invert();
    return target?.applyMatrix4(headsetFromUpright) ?? null;
  }

  /** Places the goal of a base on the floor: the trigger sets the place, and the ray then turns it. */
  private followGoal(pointing: Hand | null, isOnMenu: boolean): void {
    const steering = this.parts.steering();
    if (!this.state.placesGoal || !steering?.isBase) return;
    const floor = pointing && onFloor(this.placement, pointing.ray.from, pointing.ray.direction, steering.baseHeightM, JUMP_M);
    this.steer.placeGoal(floor, pointing?.isTrigger === true && !isOnMenu);
  }

  /** The trigger of a hand was pulled: presses the button of the menu at which it points. */
  private triggerBegins(side: Side): void {
    const hand = this.input.hand(side);
    const button = side === this.menuSide || !hand ? null : this.menu.hit(hand.ray)?.button;
    if (button && !button.isDisabled) this.press(button.id, side);
  }

  private press(id: string, side: Side): void {
    const { state } = this;
    this.parts.steering()?.used();
    if (id === "page steer-stop") this.parts.steering()?.stop();
    else if (id.startsWith("tab-")) state.tab = id.slice(4) as Tab;
    else if (id.startsWith("place-") && id !== "place-goal") this.place(id.slice(6) as typeof this.preset, this.head.matrix);
    else if (!pressPageButton(id)) this.pressOwn(id, side);
    this.menuShownAt = -Infinity;
  }

  private pressOwn(id: string, side: Side): void {
    const { state } = this;
    const choice = CHOICES.find((other) => other.id === id);
    if (choice) {
      state.fixedQuality = choice.fixed;
      this.governor.fixed = choice.fixed;
      return;
    }
    switch (id) {
      case "higher":
      case "lower":
        this.placement = moved(this.placement, new THREE.Vector3(0, id === "higher" ? HEIGHT_STEP_M : -HEIGHT_STEP_M, 0));
        break;
      case "images":
        state.showsImages = !state.showsImages;
        break;
      case "hand-picture":
        state.hasHandPicture = !state.hasHandPicture;
        break;
      case "sphere":
        state.hasSphere = !state.hasSphere;
        break;
      case "zoom-in":
      case "zoom-out":
        this.handPicture.changeZoom(id === "zoom-in");
        break;
      case "sharper":
        // 1, 2, 4, and again 1.
        this.handPicture.resolution = (2 * this.handPicture.resolution) % 7;
        this.sphere.resolution = this.handPicture.resolution;
        break;
      case "fade-sphere":
        this.sphere.opacity = this.sphere.opacity > 0.3 ? this.sphere.opacity - 0.25 : 1;
        break;
      case "vignette":
        state.hasVignette = !state.hasVignette;
        break;
      case "left-handed":
        this.letGo("the hands have changed their roles");
        state.isLeftHanded = !state.isLeftHanded;
        break;
      case "move-box":
        state.movesBox = !state.movesBox;
        break;
      case "steer-hand":
        this.steer.interrupt("steering by hand was switched off");
        state.steersByHand = !state.steersByHand;
        break;
      case "place-goal":
        state.placesGoal = !state.placesGoal;
        break;
      case "go":
        this.goSide = side;
        this.parts.steering()?.setGo(true);
        break;
      case "discard":
        this.parts.steering()?.discard();
        break;
      case "pin":
        state.isPinned = !state.isPinned;
        break;
      case "leave":
        void this.session.end();
        break;
    }
  }

  private releaseGo(): void {
    this.goSide = null;
    this.parts.steering()?.setGo(false);
  }

  // What is drawn.

  private showMenu(): void {
    const now = performance.now();
    if (!this.menu.isVisible) return;
    if (now - this.menuShownAt < MENU_MILLIS) {
      this.menu.repaintHover();
      return;
    }
    this.menuShownAt = now;
    this.state.quality = this.governor.quality;
    this.menu.show(menuContent(this.state, this.parts.steering()));
  }

  /** Warns of a cut connection wherever the operator looks. */
  private showSign(): void {
    const connection = document.getElementById("connection");
    const isOpen = connection?.dataset.state === "open";
    this.sign.text = isOpen ? "" : (connection?.textContent ?? "");
  }

  private readEyes(pose: XRViewerPose): void {
    const eyes = this.lent.renderer.xr.getCamera().cameras;
    this.eyeLenses = eyes.slice(0, pose.views.length).map((eye, ix) => {
      const { z: width, w: height } = eye.viewport!;
      const before = this.fullSizes.get(ix) ?? [0, 0];
      const full: [number, number] = [Math.max(before[0], width), Math.max(before[1], height)];
      this.fullSizes.set(ix, full);
      return lensOfProjection(eye.projectionMatrix, full);
    });
  }

  /** The view between the eyes, for which the server chooses what it sends first. */
  private updateHeadView(headsetFromHead: THREE.Matrix4, nowMillis: number): void {
    const { scale } = this.placement;
    const lens = lensAround(this.eyeLenses, VIEW_PX_PER_TANGENT);
    const worldFromHead = cameraOfThree(this.worldFromHeadset.multiply(headsetFromHead));
    this.headView = {
      world_from_camera: rowMajorPose(worldFromHead),
      size_px: lens.sizePx,
      projection: { kind: "pinhole", focal_px: lens.focalPx, principal_px: lens.principalPx },
      near_m: NEAR_M * scale,
      far_m: FAR_M * scale,
      crop: this.lent.crop.crop,
    };
    // Motions in the room are those that the eyes see, whatever the scale is.
    if (this.viewRule.isDue(this.rigidInRoom(headsetFromHead), nowMillis, false)) this.parts.moved();
  }

  /** The pose of the head in the scene, in meters of the room. */
  private rigidInRoom(headsetFromHead: THREE.Matrix4): THREE.Matrix4 {
    const matrix = this.worldFromHeadset.multiply(headsetFromHead);
    const position = new THREE.Vector3().setFromMatrixPosition(matrix).divideScalar(this.placement.scale);
    return matrix.setPosition(position);
  }

  private govern(pose: XRViewerPose, nowMillis: number): void {
    this.governor.frame(nowMillis);
    const { viewportScale, foveation } = this.governor.quality;
    for (const view of pose.views) view.requestViewportScale?.(viewportScale);
    const { xr } = this.lent.renderer;
    if (xr.getFoveation() !== foveation) xr.setFoveation(foveation);
  }

  private splatEyes(headsetFromHead: THREE.Matrix4): SplatEyes {
    const { maxReach, share } = this.governor.quality;
    return {
      worldFromHead: cameraOfThree(this.worldFromHeadset.multiply(headsetFromHead)),
      lens: { ...this.eyeLenses[0]!, nearM: NEAR_M },
      farM: FAR_M,
      maxReach,
      share,
      toleranceM: SORT_TOLERANCE_M * this.placement.scale,
      eyeOf: (camera) => {
        const { viewport } = camera as THREE.PerspectiveCamera;
        const lens = lensOfProjection(camera.projectionMatrix, [viewport!.z, viewport!.w]);
        return { worldFromEye: cameraOfThree(camera.matrixWorld), nearM: NEAR_M, ...lens };
      },
      onFill: (coveredPx) => this.governor.setCovered(coveredPx),
    };
  }

  private gripOf(side: Side): number[] | null {
    const hand = this.input.hand(side);
    return hand && new THREE.Vector3().setFromMatrixPosition(hand.grip).toArray();
  }

  /** What is drawn and where, for tests and for the console of the browser. */
  private report(): object {
    const eyes = this.lent.renderer.xr.getCamera().cameras.map((eye) => ({
      world_from_camera: rowMajorPose(cameraOfThree(eye.matrixWorld)),
      projection: lensOfProjection(eye.projectionMatrix, [eye.viewport!.z, eye.viewport!.w]),
      viewport: eye.viewport!.toArray(),
    }));
    const { origin, yawRad, scale } = this.placement;
    return {
      eyes,
      placement: { origin: origin.toArray(), yawRad, scale },
      worldFromHeadset: this.worldFromHeadset.toArray(),
      drawnBy: this.state.drawnBy,
      state: this.state,
      sign: this.sign.text,
      menu: this.menu.isVisible ? { lines: this.menu.lines, buttons: this.menu.places } : null,
      governor: { step: this.governor.step, budgetPx: this.governor.budget, fillPx: this.governor.fill },
      isSteering: this.steer.isClosed,
      hands: { left: this.gripOf("left"), right: this.gripOf("right") },
      nFrames: this.nFrames,
    };
  }
}

/** Direction of a three.js camera on the floor of the upright world: 0 along y, counterclockwise from above. */
function floorYawRad(uprightFromCamera: THREE.Matrix4): number {
  const forward = new THREE.Vector3(0, 0, -1).transformDirection(uprightFromCamera);
  const up = new THREE.Vector3(0, 1, 0).transformDirection(uprightFromCamera);
  const flat = Math.hypot(forward.x, forward.y) > 1e-3 ? forward : up;
  return Math.atan2(-flat.x, flat.y);
}
