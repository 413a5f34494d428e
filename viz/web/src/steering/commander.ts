// From what the operator does to the messages for the server. In servo mode, a source that holds the dead-man switch moves
// the arm. In preview mode, the same inputs move a goal, and only "go" moves the arm, while it is held. This file has no DOM.

import { DeadMan, type Source } from "./dead_man";
import { goalIntent, isInArea } from "./floor_goal";
import { Goal } from "./goal";
import { HandTimes } from "./hand_times";
import { ModeChoice, type Mode, RoundTrips } from "./round_trip";
import {
  type Axes,
  axesOf,
  baseIntent,
  type Deflection,
  type FrameName,
  type FrameRotations,
  isDeflected,
  jointVelocities,
  movedJoints,
  tipIntent,
  tipVelocity,
} from "./jog";
import type { PadInput } from "./gamepad";
import { LeaseKeeper } from "./lease_keeper";
import type { Arm, Intent, Part, Point, SteerMessage, SteerRequest, SteerState } from "./messages";
import { type HandSpeed, integrated, numbersOf, type Pose, poseOf, slewed } from "./pose";
import { capitalized } from "../panels/sentence";

/** A hand is not moved faster than this: well below what the server takes for a jump of the tracking. */
const HAND_SPEED: HandSpeed = { metersPerSec: 1.5, radPerSec: 6 };
/** Time for which one sample moves a hand or a goal, if the page was busy before it. */
const MAX_STEP_SECS = 0.1;
const PING_MILLIS = 250;
/** Without a message for this time, the link is regarded as cut. The server answers four pings a second. */
const SILENT_MILLIS = 1000;
/** Why the switch is open after the operator's own stop. */
const OWN_STOP = "you stopped the robot";

/** What one of the jog inputs asks for. */
export type Jog = { kind: "tip"; deflection: Deflection } | { kind: "joint"; ix: number; direction: number };

export interface CommanderEvents {
  send(request: SteerRequest): void;
  /** The rotations of the frames now. */
  rotations(): FrameRotations;
  /** Pose of the tip in the base at these joint positions; null if the robot is unknown. */
  tipAt(position: readonly number[]): Pose | null;
  /** A sentence about something that ended without the operator's wish. */
  notice(text: string): void;
}

export class Commander {
  arm: Arm | null = null;
  state: SteerState | null = null;
  frame: FrameName = "view";
  /** The part that the operator has chosen, if the robot has two. */
  private chosenPart: Part = "arm";
  /** Speed of jogging, 0 to 1. */
  speed = 0.3;
  readonly goal = new Goal();
  readonly deadMan = new DeadMan(() => this.gripChanged());
  readonly roundTrips = new RoundTrips();
  /** Whether the operator wants to preview each motion. */
  previewsAlways = false;
  private readonly choice = new ModeChoice();
  private chosen: Mode = "preview";
  private isConnected = false;
  private hasSocket = false;
  /** Whether the arm could move when the link was lost. */
  private couldMove = false;
  private readonly keeper = new LeaseKeeper();
  private readonly times: HandTimes;
  private receivedMillis = 0;
  private pingedMillis = -Infinity;
  private tickedMillis = 0;
  private sequence = 0;
  private readonly jogs = new Map<Source, Jog>();
  /** The source that moves the goal, and the axes at its press. */
  private nudge: { source: Source; axes: Axes | null } | null = null;
  /** Axes at the start of the grip. */
  private axes: Axes | null = null;
  /** The hand of the gizmo: where it is, and where the pointer wants it. */
  private hand: { now: Pose; wanted: Pose } | null = null;
  private goIntent: Intent | null = null;
  /** The goal of a base: x, y and heading in the world. */
  private floorGoal: Point | null = null;
  /** Whether the base has been at this goal. */
  private hasArrived = false;
  /** Whether the triggers of the gamepad were seen open since the page has paid attention to it. */
  private isPadReady = false;
  /** Whether the gamepad's button for a stop is down, and the one that switches between arm and base. */
  private isPadStop = false;
  private isPadSwitch = false;

  /** `device` differs from that of every other page, because each one counts its grips from the beginning. */
  constructor(
    private readonly device: number,
    private readonly events: CommanderEvents,
  ) {
    this.times = new HandTimes(device);
  }

  get hasControl(): boolean {
    return this.isConnected && this.arm !== null && this.state?.holder === this.arm.client;
  }

  /** Whether operators move both the arm and the base. */
  get hasBothParts(): boolean {
    return this.arm !== null && this.arm.base !== null && this.arm.joints.length > 0;
  }

  /** The part that all inputs move. */
  get part(): Part {
    if (this.hasBothParts) return this.chosenPart;
    return this.arm?.base ? "base" : "arm";
  }

  /** Chooses the part that all inputs move. A part that moves brakes. */
  choosePart(part: Part): void {
    if (!this.hasBothParts || part === this.chosenPart) return;
    this.interrupt(`the ${part} was chosen`);
    this.jogs.clear();
    this.goal.clear();
    this.setBaseGoal(null);
    this.goIntent = null;
    this.chosenPart = part;
  }

  /** Makes the stowed posture of the arm its goal. */
  stow(): void {
    const stowed = this.arm?.base?.stowed;
    if (!stowed || !this.hasBothParts) return;
    this.choosePart("arm");
    this.preview(stowed);
  }

  /** Whether a press moves the arm or the goal. */
  get maySteer(): boolean {
    return this.hasControl && this.state?.stop === null;
  }

  /** Whether the arm can move, so that everybody needs the stop button. */
  get canMove(): boolean {
    const { state } = this;
    if (!state) return this.couldMove;
    // After a recovery, motion is permitted, if nobody stops the arm before.
    return state.is_moving || state.is_recovering || (state.holder !== null && state.stop === null);
  }

  /** Whether a stop can be sent. A link that is silent may still carry it. */
  get canSend(): boolean {
    return this.hasSocket;
  }

  /** Whether messages arrive. */
  get isOpen(): boolean {
    return this.isConnected;
  }

  get mode(): Mode {
    // A velocity of a base needs no preview: over a slow link, the base brakes as soon as commands are late.
    if (this.part === "base") return "servo";
    return this.previewsAlways ? "preview" : this.chosen;
  }

  /** The goal of a base; null if there is none. */
  get baseGoal(): Point | null {
    return this.floorGoal;
  }

  /** Whether a base may be sent to its goal. */
  get mayGoToBaseGoal(): boolean {
    return this.floorGoal !== null && isInArea(this.floorGoal, this.arm?.base?.area_m ?? null);
  }

  /** Median time from the hand to the joints over the last commands of this page, milliseconds; null if there are none. */
  get handToJointMillis(): number | null {
    return this.state && this.times.millis(this.state);
  }

  /** Where the gizmo is: at the hand, at the goal, or at the tip of the arm. In the base; null without an arm. */
  get gizmo(): Pose | null {
    if (this.part === "base") return null;
    if (this.hand && this.deadMan.source === "gizmo") return this.hand.now;
    return this.goalTip() ?? (this.state && poseOf(this.state.base_from_tip));
  }

  private goalTip(): Pose | null {
    const { target } = this.goal;
    if (!target) return null;
    return target.kind === "pose" ? target.baseFromTip : this.events.tipAt(target.position);
  }

  // What arrives.

  connected(nowMillis: number): void {
    this.hasSocket = true;
    this.roundTrips.restart();
    this.receivedMillis = nowMillis;
    this.pingedMillis = -Infinity;
  }

  disconnected(): void {
    this.couldMove = this.canMove;
    this.hasSocket = false;
    this.isConnected = false;
    this.state = null;
    this.roundTrips.restart();
    this.goal.clear();
    this.floorGoal = null;
    this.permit("the link to the arm is cut");
  }

  receive(message: SteerMessage, nowMillis: number): void {
    this.receivedMillis = nowMillis;
    switch (message.type) {
      case "arm":
        this.arm = message;
        this.isConnected = true;
        break;
      case "state":
        this.isConnected = this.arm !== null;
        this.receiveState(message, nowMillis);
        break;
      case "preview":
        this.goal.answer(message);
        break;
      case "pong":
        this.roundTrips.pong(message.id, message.time_micros, nowMillis);
        break;
      case "refused":
        // After a refused command, the chain may have used the grip up.
        if (message.request === "command") this.deadMan.open(message.text);
        else this.events.notice(capitalized(message.text));
        break;
    }
  }

  private receiveState(state: SteerState, nowMillis: number): void {
    const hadControl = this.hasControl;
    this.state = state;
    if (this.hasControl && !hadControl) this.keeper.used(nowMillis);
    this.permit(state.stop ?? "control of the arm has ended");
    if (hadControl && !this.hasControl) {
      this.goal.clear();
      this.floorGoal = null;
      this.nudge = null;
    }
    this.times.add(state);
    if (this.deadMan.source === null && this.goal.isReached(state.position) && this.goIntent) {
      this.goIntent = null;
      this.goal.clear();
    }
    // A goal that was reached is removed after the release.
    if (state.base?.has_arrived) this.hasArrived = true;
    else if (this.hasArrived && this.deadMan.source === null) this.setBaseGoal(null);
  }

  private permit(reason: string): void {
    const may = this.maySteer && !this.keeper.isHidden;
    // The server must see an open switch before the first grip.
    if (this.deadMan.permit(may, reason) && may) this.sample();
  }

  // What the operator does.

  /** The operator uses the page. */
  used(nowMillis: number): void {
    this.keeper.used(nowMillis);
  }

  stop(): void {
    this.deadMan.open(OWN_STOP);
    this.events.send({ type: "stop" });
    if (!this.canSend) this.events.notice("The stop was not sent, because the link to the arm is cut: use the emergency stop");
  }

  /** The page is shown or hidden. */
  setHidden(isHidden: boolean, nowMillis: number): void {
    if (isHidden === this.keeper.isHidden) return;
    this.keeper.setHidden(isHidden, nowMillis);
    if (isHidden) this.deadMan.loseEvents("the page is hidden");
    this.nudge = null;
    this.permit("the page is hidden");
  }

  /** Opens the switch. Whatever is pressed must be released and pressed again. */
  interrupt(reason: string): void {
    this.nudge = null;
    this.deadMan.open(reason);
  }

  /** The window no longer receives the events of keys and pointers. */
  loseEvents(reason: string): void {
    this.nudge = null;
    this.jogs.clear();
    this.deadMan.loseEvents(reason);
  }

  /** Begins to drag the hand, or the goal. Returns whether the pointer has it. */
  beginDrag(): boolean {
    const { gizmo } = this;
    if (!gizmo || !this.maySteer) return false;
    this.hand = { now: gizmo, wanted: gizmo };
    if (this.mode === "preview") {
      this.deadMan.press("gizmo", false);
      return this.deadMan.source === null;
    }
    // A goal of an earlier preview would leave the gizmo there.
    this.goal.clear();
    const tip = poseOf(this.state!.base_from_tip);
    this.hand = { now: tip, wanted: tip };
    return this.deadMan.press("gizmo");
  }

  /** Drags to a pose in the base. */
  dragTo(baseFromHand: Pose): void {
    if (this.deadMan.source === "gizmo") this.hand = { now: this.hand?.now ?? baseFromHand, wanted: baseFromHand };
    else if (this.mode === "preview" && this.maySteer) this.setGoal({ kind: "pose", baseFromTip: baseFromHand });
  }

  endDrag(): void {
    this.deadMan.release("gizmo");
    this.hand = null;
  }

  /** Makes these joint positions the goal. */
  preview(position: readonly number[]): void {
    if (this.maySteer) this.setGoal({ kind: "joints", position: [...position] });
  }

  /** Sets the goal of the base; null removes it. */
  setBaseGoal(goal: Point | null): void {
    if (this.deadMan.source === "go" || this.deadMan.source === "pad go") this.deadMan.open("the goal has changed");
    this.floorGoal = goal;
    this.hasArrived = false;
  }

  private setGoal(target: Parameters<Goal["set"]>[0]): void {
    if (this.deadMan.source === "go" || this.deadMan.source === "pad go") this.deadMan.open("the goal has changed");
    this.goIntent = null;
    this.goal.set(target);
  }

  /** Holds or releases "go". */
  setGo(isHeld: boolean, source: "go" | "pad go" = "go"): void {
    if (!isHeld) {
      this.deadMan.release(source);
      return;
    }
    const before = this.goIntent;
    // The press sends the first sample of the grip, which must have the intent.
    this.goIntent = this.part === "base" ? this.baseGoalIntent() : this.goal.intent;
    if (!this.deadMan.press(source, this.goIntent !== null)) this.goIntent = before;
  }

  private baseGoalIntent(): Intent | null {
    return this.floorGoal && this.mayGoToBaseGoal ? goalIntent(this.floorGoal) : null;
  }

  /** Sets what a source of jogging asks for; null if it is released. */
  setJog(source: "keys" | "pad" | "button", jog: Jog | null): void {
    if (!jog) {
      this.jogs.delete(source);
      this.deadMan.release(source);
      if (this.nudge?.source === source) this.nudge = null;
      return;
    }
    const isNew = !this.jogs.has(source);
    this.jogs.set(source, jog);
    if (!isNew) return;
    const isPreview = this.mode === "preview";
    const axes = this.axesNow();
    const hasAxes = jog.kind === "joint" || axes !== null || this.part === "base";
    if (!hasAxes) this.events.notice("The pose of the robot in the view is not known yet: choose the frame of the tool or the base");
    this.deadMan.press(source, hasAxes && !isPreview);
    if (isPreview && hasAxes && this.maySteer && !this.nudge) this.nudge = { source, axes };
  }

  /**
   * Adopts what a gamepad reports; null if there is none. Without attention, it can only stop the arm. A trigger that is pulled
   * when the attention begins has no effect before it is released and pulled again.
   */
  setPad(input: PadInput | null, hasAttention = true): void {
    const isStop = input?.isStop === true;
    const isSwitch = input?.isSwitch === true && hasAttention && !input.isHeld;
    if (isSwitch && !this.isPadSwitch) this.choosePart(this.part === "arm" ? "base" : "arm");
    this.isPadSwitch = isSwitch;
    // During a recovery, the arm is stopped already, so that each press is one more stop.
    if (isStop && this.canMove && (this.state?.stop === null || !this.isPadStop)) this.stop();
    this.isPadStop = isStop;
    this.isPadReady = input !== null && hasAttention && (this.isPadReady || !input.isHeld);
    const isHeld = this.isPadReady && input?.isHeld === true;
    const isGo = isHeld && input.isGo;
    const isJogging = isHeld && !isGo;
    // The trigger is pulled before the other button, so that it is let go first.
    this.setJog("pad", isJogging ? { kind: "tip", deflection: input.deflection } : null);
    this.setGo(isGo, "pad go");
    if (this.deadMan.source === "pad" && input && isDeflected(input.deflection)) this.goal.clear();
  }

  private axesNow(): Axes | null {
    return axesOf(this.frame, this.events.rotations());
  }

  private gripChanged(): void {
    const { source, reason } = this.deadMan;
    if (source === null) {
      // After a stop, or without control, holding again has no effect.
      const advice = this.maySteer && reason !== OWN_STOP ? ". Let go and hold again" : "";
      if (reason !== "") this.events.notice(`Released: ${reason}${advice}`);
      this.axes = null;
    } else {
      this.axes = this.axesNow();
      // A trigger of a gamepad may be the first half of "go".
      if (source === "gizmo" || source === "keys" || source === "button") this.goal.clear();
      this.events.notice("");
    }
    // The arm must not wait for the next sample to brake.
    this.sample();
  }

  // What is sent.

  /** Called about 50 times a second. */
  tick(nowMillis: number): void {
    const secs = Math.min(MAX_STEP_SECS, Math.max(0, (nowMillis - this.tickedMillis) / 1000));
    this.tickedMillis = nowMillis;
    if (!this.arm) return;
    this.deadMan.tick(nowMillis, 1000 * this.arm.expiry_secs);
    if (this.isConnected && nowMillis - this.receivedMillis > SILENT_MILLIS) {
      this.isConnected = false;
      this.permit("the link to the arm is silent");
    }
    this.chooseMode(nowMillis);
    this.moveHand(secs);
    this.moveGoal(secs);
    if (this.deadMan.grip !== null || this.nudge) this.keeper.used(nowMillis);
    if (nowMillis - this.pingedMillis >= PING_MILLIS) {
      this.pingedMillis = nowMillis;
      this.events.send({ type: "ping", id: this.roundTrips.ping(nowMillis) });
    }
    const question = this.maySteer ? this.goal.question(nowMillis) : null;
    if (question) this.events.send(question);
    if (this.hasControl) this.keepControl(nowMillis);
  }

  private chooseMode(nowMillis: number): void {
    const before = this.chosen;
    const millis = this.roundTrips.millis(nowMillis);
    const mode = this.choice.update(millis, this.arm!.servo_round_trip_millis, nowMillis);
    // A goal that is being approached, or dragged, is not taken away.
    if (mode === "servo" && before === "preview" && (this.deadMan.grip !== null || this.hand || this.nudge)) return;
    this.chosen = mode;
    if (mode === "preview" && before === "servo" && this.deadMan.source !== "go" && this.deadMan.source !== "pad go") {
      this.deadMan.open("the link has become slow, so that motions are previewed");
    }
  }

  private moveHand(secs: number): void {
    if (!this.hand || this.deadMan.source !== "gizmo") return;
    this.hand.now = slewed(this.hand.now, this.hand.wanted, secs, HAND_SPEED);
  }

  /** Moves the goal as the held jog input asks. */
  private moveGoal(secs: number): void {
    const { nudge, state, arm } = this;
    const jog = nudge && this.jogs.get(nudge.source);
    if (!nudge || !jog || !state || !arm || !this.maySteer || this.mode !== "preview") return;
    if (jog.kind === "joint") {
      const { target, judgment } = this.goal;
      const from = target?.kind === "joints" ? target.position : ((target && judgment?.position) ?? state.position);
      const velocity = jointVelocities(arm.joints, jog.ix, jog.direction, this.speed);
      this.setGoal({ kind: "joints", position: movedJoints(arm.joints, from, velocity, secs) });
    } else if (nudge.axes && isDeflected(jog.deflection)) {
      const { linear, angular } = tipVelocity(nudge.axes, jog.deflection, this.speed);
      const from = this.goalTip() ?? poseOf(state.base_from_tip);
      this.setGoal({ kind: "pose", baseFromTip: integrated(from, linear, angular, secs) });
    }
  }

  private keepControl(nowMillis: number): void {
    const keeping = this.keeper.keep(nowMillis);
    if (keeping === "sample") this.sample();
    else if (keeping !== "nothing") this.events.send({ type: "lease", action: keeping });
    if (keeping === "release") this.events.notice(`Control was given back, because ${this.keeper.reason(nowMillis)}`);
  }

  /** Sends the state of the dead-man switch and, while it is held, what the operator wants. */
  private sample(): void {
    const captured_micros = this.roundTrips.serverMicros(performance.now());
    const { grip } = this.deadMan;
    if (!this.hasControl || (captured_micros === null && grip !== null)) return;
    this.sequence += 1;
    const command = { type: "command", device: this.device, sequence: this.sequence, grip } as const;
    const intent = grip === null ? null : this.intent();
    // An open switch counts whatever its stamp is.
    this.events.send({ ...command, captured_micros: captured_micros ?? 0, ...(intent && { intent }) });
  }

  private intent(): Intent | null {
    const { source } = this.deadMan;
    if (source === "gizmo") return this.hand && { kind: "hand", base_from_hand: numbersOf(this.hand.now) };
    if (source === "go" || source === "pad go") return this.goIntent;
    const jog = source && this.jogs.get(source);
    const { arm } = this;
    if (!jog || !arm) return null;
    if (arm.base && this.part === "base") return jog.kind === "tip" ? baseIntent(arm.base, jog.deflection, this.speed) : null;
    if (jog.kind === "joint") {
      return { kind: "joint_velocity", velocity: jointVelocities(arm.joints, jog.ix, jog.direction, this.speed) };
    }
    return this.axes && tipIntent(tipVelocity(this.axes, jog.deflection, this.speed));
  }
}
