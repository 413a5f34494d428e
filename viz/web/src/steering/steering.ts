// Steering on the page: connects the link to the arm, the operator's inputs, the panel, and what is drawn in the view.

import * as THREE from "three";
import { announce } from "../panels/announcer";
import { element } from "../panels/element";
import { setText } from "../panels/html";
import { capitalized } from "../panels/sentence";
import { disable } from "../panels/title";
import { showToast } from "../panels/toast";
import type { action, toggle } from "../keys";
import { worldFromCamera } from "../view/convention";
import type { OrbitView } from "../view/orbit_view";
import { Commander } from "./commander";
import { FloorGoalTool } from "./floor_goal_tool";
import { firstPad } from "./gamepad";
import { Ghost, type GhostParts } from "./ghost";
import { isApart, lookOfLimits, lookOfVerdict, LOOKS } from "./ghost_looks";
import { Gizmo } from "./gizmo";
import { HandSteering } from "./hand_steering";
import { holdButton } from "./hold_button";
import { axesOf, type FrameName, type FrameRotations } from "./jog";
import { JogKeys } from "./jog_keys";
import { JogPad } from "./jog_pad";
import { LeasePanel } from "./lease_panel";
import { LimitsList } from "./limits_list";
import { Marks } from "./marks";
import type { Part, Point, SteerMessage, SteerRequest } from "./messages";
import { numbersOf, type Pose, poseOf, poseOfMatrix } from "./pose";
import { PoseList } from "./pose_list";
import { SteerSocket } from "./steer_socket";
import { StopButton } from "./stop_button";
import { avoidanceText, baseGoalText, baseText, modeText, verdictText } from "./texts";

// One script for both, because they draw the same ghost.
export { Incidents } from "../incidents/incidents";

/** Period of the samples: 50 Hz, so that two can be lost before the arm brakes. */
const TICK_MILLIS = 20;
/** Minimum time between two views for the log of the run. */
const VIEW_MILLIS = 200;
/** Period at which the panel is updated. */
const SHOW_MILLIS = 100;
/** Places in the world. */
const ORIGIN: Pose = { position: new THREE.Vector3(), rotation: new THREE.Quaternion() };

/** What the script uses of the page, whose modules it cannot import as far as they have a state. */
export interface PageParts extends GhostParts {
  view: OrbitView;
  action: typeof action;
  toggle: typeof toggle;
}

export class Steering {
  private readonly commander: Commander;
  private readonly socket: SteerSocket;
  private readonly ghost: Ghost;
  private readonly gizmo: Gizmo;
  private readonly floorGoal: FloorGoalTool;
  private readonly camera: THREE.PerspectiveCamera;
  private readonly stopButton: StopButton;
  private readonly lease: LeasePanel;
  private readonly jogPad: JogPad;
  private readonly jogKeys: JogKeys;
  private readonly limits: LimitsList;
  private handSteering: HandSteering | null = null;
  private shownMillis = -Infinity;
  private shownMode = "";
  /** The last view that was sent, as text, and when. */
  private sentView = { text: "", millis: -Infinity };
  /** The gamepad that was read last. */
  private padIx: number | null = null;
  /** The last joint positions of which the pose of the tip was computed. */
  private tip: { position: readonly number[]; pose: Pose | null } | null = null;

  private readonly view: OrbitView;

  constructor(page: PageParts) {
    const { view } = page;
    this.view = view;
    const changed = (): void => view.changed();
    const canvas = element("canvas", HTMLCanvasElement);
    this.commander = new Commander(Math.floor(Math.random() * 2 ** 48), {
      send: (request) => this.send(request),
      rotations: () => this.rotations(),
      tipAt: (position) => this.tipAt(position),
      notice: (text) => this.notice(text),
    });
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new SteerSocket(`${scheme}://${location.host}/steer`, {
      opened: () => this.commander.connected(performance.now()),
      closed: () => this.closed(),
      message: (message) => this.receive(message),
    });
    this.ghost = new Ghost(view.robot, view.occlusion, page, changed);
    let camera: THREE.PerspectiveCamera | null = null;
    this.gizmo = view.addTool((ofView) => {
      camera = ofView;
      return new Gizmo(ofView, canvas, this.gizmoEvents(), changed);
    });
    this.camera = camera!;
    this.floorGoal = view.addTool((ofView) => {
      const chosen = (goal: Point): void => {
        this.commander.setBaseGoal(goal);
        this.draw();
      };
      return new FloorGoalTool(ofView, canvas, chosen, () => this.choosePlace(false), changed);
    });
    const marks = view.addTool((ofView) => new Marks(ofView, canvas, changed));
    view.addTool(() => ({ root: this.ghost.root, hasTakenPress: false, update: () => undefined }));
    const send = (request: SteerRequest): void => this.send(request);
    this.stopButton = new StopButton(this.commander, page.action, (stop) => send({ type: "rearm", stop }));
    this.lease = new LeasePanel(this.commander, send);
    this.jogPad = new JogPad(this.commander);
    this.jogKeys = new JogKeys(this.commander, page.toggle, (part) => this.choosePart(part));
    this.limits = new LimitsList(this.commander, marks);
    new PoseList(this.commander, (text) => this.notice(text));
    this.setUpControls();
    this.listenToThePage(canvas);
    window.setInterval(() => this.tick(), TICK_MILLIS);
  }

  /** How a headset steers. */
  get hands(): HandSteering {
    this.handSteering ??= new HandSteering(this.commander, () => this.worldFromBase, () => this.draw());
    return this.handSteering;
  }

  /** Whether the server has an arm that can be steered. */
  set offered(isOffered: boolean) {
    this.socket.wanted = isOffered;
  }

  private gizmoEvents(): ConstructorParameters<typeof Gizmo>[2] {
    return {
      begin: () => {
        const hasBegun = this.commander.beginDrag();
        this.show();
        return hasBegun;
      },
      drag: (baseFromHand) => {
        this.commander.used(performance.now());
        this.commander.dragTo(baseFromHand);
      },
      end: () => this.commander.endDrag(),
    };
  }

  private setUpControls(): void {
    const { commander } = this;
    const frame = element("steer-frame", HTMLSelectElement);
    frame.addEventListener("change", () => {
      commander.frame = frame.value as FrameName;
      this.show();
    });
    const speed = element("steer-speed", HTMLInputElement);
    speed.addEventListener("input", () => {
      commander.speed = speed.valueAsNumber / 100;
      element("steer-speed-value").textContent = `${speed.value} %`;
    });
    const always = element("steer-always", HTMLInputElement);
    always.addEventListener("change", () => {
      commander.interrupt("another way of moving was chosen");
      commander.previewsAlways = always.checked;
      if (!always.checked) commander.goal.clear();
      this.show();
    });
    holdButton(element("steer-go"), (isHeld) => commander.setGo(isHeld));
    for (const part of ["arm", "base"] as const) {
      element(`steer-part-${part}`).addEventListener("click", () => this.choosePart(part));
    }
    element("steer-stow").addEventListener("click", () => {
      commander.stow();
      this.show();
    });
    element("steer-place").addEventListener("click", () => this.choosePlace(!this.floorGoal.isChoosing));
    element("steer-discard").addEventListener("click", () => {
      commander.interrupt("the goal was discarded");
      commander.goal.clear();
      commander.setBaseGoal(null);
      this.show();
    });
    for (const kind of ["pointerdown", "keydown"] as const) {
      element("steer").addEventListener(kind, () => commander.used(performance.now()), { passive: true });
    }
  }

  /** Everything after which the page may not see the release of a key or pointer. */
  private listenToThePage(canvas: HTMLCanvasElement): void {
    const lose = (reason: string) => (): void => {
      this.commander.loseEvents(reason);
      this.gizmo.giveUp();
    };
    window.addEventListener("blur", lose("another window has the focus"));
    window.addEventListener("pagehide", lose("the page is closed"));
    window.addEventListener("contextmenu", (event) => event.defaultPrevented || lose("a menu is open")());
    canvas.addEventListener("webglcontextlost", () => {
      this.commander.interrupt("the view cannot be drawn");
      this.gizmo.giveUp();
    });
    document.addEventListener("visibilitychange", () => {
      if (document.hidden) lose("the page is hidden")();
      this.commander.setHidden(document.hidden, performance.now());
    });
    this.commander.setHidden(document.hidden, performance.now());
  }

  private send(request: SteerRequest): void {
    this.socket.send(request);
  }

  private receive(message: SteerMessage): void {
    this.commander.receive(message, performance.now());
    if (message.type === "arm") {
      this.notice("");
      this.showPart();
    }
    if (message.type === "state" || message.type === "preview") this.draw();
    if (message.type === "state" || message.type === "arm") this.stopButton.show();
  }

  /** Lets the next press on the view choose the goal of the base, or not. */
  private choosePlace(isChoosing: boolean): void {
    this.floorGoal.isChoosing = isChoosing;
    element("steer-place").ariaPressed = String(isChoosing);
    this.show();
  }

  private choosePart(part: Part): void {
    this.choosePlace(false);
    this.commander.choosePart(part);
    this.gizmo.giveUp();
    this.show();
    announce(`You move the ${part}`);
  }

  /** Shows the controls of the chosen part. */
  private showPart(): void {
    const { part, hasBothParts, arm } = this.commander;
    const panel = element("steer");
    if (panel.dataset.robot !== part) {
      panel.dataset.robot = part;
      this.gizmo.place(null);
      this.ghost.hide();
    }
    element("steer-parts").hidden = !hasBothParts;
    for (const shown of ["arm", "base"] as const) element(`steer-part-${shown}`).ariaPressed = String(part === shown);
    element("steer-stow").hidden = arm?.base?.stowed == null || !hasBothParts;
    setText(element("steer-avoidance"), arm?.base ? avoidanceText(arm.base.avoidance) : "");
    element("steer-avoidance").dataset.avoidance = arm?.base?.avoidance ?? "";
  }

  private closed(): void {
    this.commander.disconnected();
    this.gizmo.giveUp();
    this.show();
  }

  private tick(): void {
    const now = performance.now();
    this.socket.check();
    const { commander } = this;
    this.readPad();
    commander.tick(now);
    this.sendView(now);
    if (commander.deadMan.source === "gizmo") this.placeGizmo();
    if (now - this.shownMillis >= SHOW_MILLIS) this.show();
  }

  /** Sends what the operator sees, if it has changed. It becomes a part of the log of the run. */
  private sendView(now: number): void {
    if (!this.commander.hasControl) this.sentView.text = "";
    else if (now - this.sentView.millis >= VIEW_MILLIS) {
      const world_from_camera = numbersOf(poseOfMatrix(worldFromCamera(this.view.view().world_from_camera)));
      const text = JSON.stringify(world_from_camera);
      if (text !== this.sentView.text) this.send({ type: "view", world_from_camera });
      this.sentView = { text, millis: now };
    }
  }

  private readPad(): void {
    const { commander } = this;
    // Browsers do not update gamepads for hidden pages, and have none on insecure ones.
    const pads = document.hidden ? [] : (navigator.getGamepads?.() ?? []);
    const pad = firstPad(pads);
    // Gamepads report also to pages without the focus, while the operator may use another program.
    const hasAttention = commander.hasControl && document.hasFocus() && pad?.ix === this.padIx;
    this.padIx = pad?.ix ?? null;
    commander.setPad(pad?.input ?? null, hasAttention);
    const unknown = pads.some((other) => other !== null) ? "The gamepad has an unknown layout and is not used" : "";
    const both = this.commander.hasBothParts ? ". Y switches between arm and base" : "";
    const padText = `Gamepad: hold a trigger, move the sticks${both}`;
    setText(element("steer-pad"), pad ? padText : unknown);
  }

  private notice(text: string): void {
    const note = element("steer-note");
    if (note.textContent === capitalized(text)) return;
    note.textContent = capitalized(text);
    if (text === "") return;
    announce(text);
    if (element("steer").hidden) showToast(capitalized(text));
  }

  // What is drawn.

  private get worldFromBase(): Pose | null {
    const { arm } = this.commander;
    const matrix = arm && this.view.robot.linkPose(arm.base_link);
    return matrix && poseOfMatrix(matrix);
  }

  private rotations(): FrameRotations {
    const { state } = this.commander;
    this.camera.updateMatrixWorld();
    return {
      baseFromWorld: this.worldFromBase?.rotation.invert() ?? null,
      worldFromEye: this.camera.getWorldQuaternion(new THREE.Quaternion()),
      baseFromTip: state ? poseOf(state.base_from_tip).rotation : new THREE.Quaternion(),
    };
  }

  private get jointNames(): string[] {
    return this.commander.arm?.joints.map(({ name }) => name) ?? [];
  }

  private tipAt(position: readonly number[]): Pose | null {
    const { arm } = this.commander;
    if (!arm) return null;
    if (this.tip?.position !== position || this.tip.pose === null) {
      this.tip = { position, pose: this.ghost.linkInLink(arm.base_link, arm.tip_link, this.jointNames, position) };
    }
    return this.tip.pose;
  }

  private draw(): void {
    if (this.commander.arm?.base) this.drawFloorGoal();
    if (this.commander.arm?.joints.length) {
      this.placeGizmo();
      this.drawGhost();
    }
    // Places of a base are in the world.
    this.limits.show({ arm: this.worldFromBase, base: ORIGIN });
  }

  private drawFloorGoal(): void {
    const { baseGoal, state } = this.commander;
    const heading = state?.base?.world_from_base?.[2] ?? 0;
    this.floorGoal.show(baseGoal ?? state?.base?.goal ?? null, { z: this.worldFromBase?.position.z ?? 0, heading });
  }

  private placeGizmo(): void {
    const { commander, worldFromBase } = this;
    const hand = commander.maySteer ? commander.gizmo : null;
    const axes = axesOf(commander.frame, this.rotations());
    if (!worldFromBase || !hand || !axes) {
      this.gizmo.place(null);
      return;
    }
    // The gizmo of the tool turns with the hand.
    const baseFromAxes = commander.frame === "tool" ? hand.rotation : axes.baseFromAxes;
    const worldFromAxes = worldFromBase.rotation.clone().multiply(baseFromAxes);
    this.gizmo.place({ worldFromBase, baseFromHand: hand, worldFromAxes });
  }

  private drawGhost(): void {
    const { state, goal } = this.commander;
    const { judgment, target } = goal;
    if (target) {
      const position = target.kind === "joints" ? target.position : judgment?.position;
      const look = judgment ? lookOfVerdict(judgment.verdict) : "checking";
      // Without a solution, any ghost would be in the wrong place: the gizmo shows where the goal is.
      if (position) this.ghost.show(this.jointNames, position, look);
      else this.ghost.hide();
    } else if (state?.target && isApart(state.target, state.position)) {
      this.ghost.show(this.jointNames, state.target, lookOfLimits(state.limits));
    } else {
      this.ghost.hide();
    }
  }

  // The panel.

  private show(): void {
    this.shownMillis = performance.now();
    const { commander } = this;
    this.stopButton.show();
    this.lease.show();
    this.jogKeys.show();
    if (!element("steer").hidden) this.jogPad.show();
    this.showMode();
    this.showPart();
    if (this.commander.part === "base") this.showBaseGoal();
    else this.showGoal();
    this.showTime();
    const contacts = commander.state?.contacts ?? 0;
    setText(element("steer-contacts"), contacts > 0 ? `The robot has touched the scene ${contacts} times` : "");
    if (!commander.state) {
      this.gizmo.place(null);
      this.ghost.hide();
      this.floorGoal.show(null, { z: 0, heading: 0 });
      this.limits.show(null);
    } else if (commander.maySteer && commander.deadMan.source === null) {
      this.draw(); // The view and the chosen axes change without a message.
    }
  }

  private showMode(): void {
    const { arm, mode, part, roundTrips, previewsAlways, hasControl } = this.commander;
    const millis = roundTrips.millis(performance.now());
    const ofArm = arm ? modeText(mode, millis, arm.servo_round_trip_millis, previewsAlways) : "";
    const text = part === "base" ? baseText(millis) : ofArm;
    setText(element("steer-mode"), text);
    element("steer-mode").dataset.mode = mode;
    const shown = `${part} ${mode}`;
    if (hasControl && shown !== this.shownMode) announce(text.split(" (")[0]!);
    this.shownMode = hasControl ? shown : "";
  }

  private showGoal(): void {
    const { goal, state } = this.commander;
    const { target, judgment } = goal;
    element("steer-goal").hidden = target === null;
    const isThere = state !== null && goal.isReached(state.position);
    const verdict = judgment ? verdictText(judgment.verdict, judgment.text) : "Checking the goal";
    setText(element("steer-verdict"), target ? (isThere ? "The arm is at the goal" : verdict) : "");
    element("steer-verdict").title = judgment ? `Look of the ghost: ${LOOKS[lookOfVerdict(judgment.verdict)].name}` : "";
    // While it is held, a disabled button would get no release.
    const isHeld = this.commander.deadMan.source === "go";
    const reason = goal.intent || isHeld ? "" : "The goal cannot be reached, or is still being checked";
    disable(element("steer-go", HTMLButtonElement), reason);
  }

  private showBaseGoal(): void {
    const { baseGoal, mayGoToBaseGoal, state, deadMan, maySteer } = this.commander;
    element("steer-goal").hidden = baseGoal === null;
    const text = baseGoalText(state?.base?.has_arrived === true, mayGoToBaseGoal);
    setText(element("steer-verdict"), baseGoal ? text : "");
    disable(element("steer-go", HTMLButtonElement), mayGoToBaseGoal || deadMan.source === "go" ? "" : text);
    if (!maySteer && this.floorGoal.isChoosing) this.choosePlace(false);
  }

  private showTime(): void {
    const millis = this.commander.handToJointMillis;
    const label = element("steer-time");
    label.hidden = millis === null;
    if (millis !== null) setText(label, `hand to joint ${Math.round(millis)} ms`);
  }
}
