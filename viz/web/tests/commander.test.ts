import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { Quaternion } from "three";
import { Commander } from "../src/steering/commander";
import { NO_DEFLECTION } from "../src/steering/jog";
import type { SteerMessage, SteerRequest, SteerState } from "../src/steering/messages";
import { poseOf } from "../src/steering/pose";
import { ARM, BASE, BOTH, CLIENT, STATE } from "./steering_examples";
import { assertClose, fakeClock } from "./close";

type Command = SteerRequest & { type: "command" };

const FORWARD = { kind: "tip", deflection: { ...NO_DEFLECTION, forward: 1 } } as const;
const DEVICE = 42;
const PAD = { isHeld: false, isGo: false, isStop: false, isSwitch: false, deflection: { ...NO_DEFLECTION, up: 1 } };

/** A commander whose server answers after a fixed time, and everything that was sent and said. */
class Bench {
  readonly sent: SteerRequest[] = [];
  readonly notices: string[] = [];
  roundTripMillis = 10;
  eye = new Quaternion();
  readonly commander: Commander;
  private pings: { id: number; at: number }[] = [];

  constructor(readonly clock: { millis: number }) {
    this.commander = new Commander(DEVICE, {
      send: (request) => {
        this.sent.push(request);
        if (request.type === "ping") this.pings.push({ id: request.id, at: this.clock.millis });
      },
      rotations: () => ({ baseFromWorld: new Quaternion(), worldFromEye: this.eye, baseFromTip: new Quaternion() }),
      tipAt: () => poseOf([0.1, 0.2, 0.3, 0, 0, 0, 1]),
      notice: (text) => this.notices.push(text),
    });
    this.commander.frame = "base";
    this.commander.connected(clock.millis);
    this.commander.receive(ARM, clock.millis);
  }

  state(change: Partial<SteerState> = {}): void {
    this.commander.receive({ ...STATE, ...change }, this.clock.millis);
  }

  /** Lets time pass, in steps of the page's timer. The server sends states. */
  run(millis: number, change: Partial<SteerState> = {}): void {
    for (let passed = 0; passed < millis; passed += 20) {
      this.clock.millis += 20;
      for (const { id, at } of this.pings.splice(0)) {
        if (this.clock.millis - at < this.roundTripMillis) this.pings.push({ id, at });
        else this.commander.receive({ type: "pong", id, time_micros: 1000 * (at + 0.5 * this.roundTripMillis) }, at + this.roundTripMillis);
      }
      this.state(change);
      this.commander.tick(this.clock.millis);
    }
  }

  commands(): Command[] {
    return this.sent.filter((request): request is Command => request.type === "command");
  }

  last(): Command {
    return this.commands().at(-1)!;
  }
}

let bench: Bench;

beforeEach((context) => {
  bench = new Bench(fakeClock(context as Parameters<typeof fakeClock>[0]));
});

test("without control, nothing is sent but pings, and no press moves the arm", () => {
  bench.run(1500, { holder: 3 });
  bench.commander.setJog("keys", FORWARD);
  assert.equal(bench.commander.beginDrag(), false);
  bench.run(100, { holder: 3 });
  assert.deepEqual(new Set(bench.sent.map(({ type }) => type)), new Set(["ping"]));
});

test("with control, samples with an open switch precede the first grip, and numbers increase", () => {
  bench.run(1500);
  assert.equal(bench.commander.mode, "servo");
  bench.commander.setJog("keys", FORWARD);
  bench.run(100);
  bench.commander.setJog("keys", null);
  const commands = bench.commands();
  assert.equal(commands[0]!.grip, null);
  assert.deepEqual([...new Set(commands.map(({ grip }) => grip))], [null, 1]);
  assert.equal(bench.last().grip, null, "the release is sent at once");
  assert.ok(commands.every(({ sequence }, ix) => ix === 0 || sequence > commands[ix - 1]!.sequence));
  const { intent, device } = commands.find(({ grip }) => grip === 1)!;
  assert.equal(device, DEVICE);
  assert.ok(intent?.kind === "tip_velocity");
  assertClose(intent.linear_m_s, [0.25 * 0.3, 0, 0], 1e-9);
});

test("samples are stamped with the server's clock", () => {
  bench.run(1000);
  bench.run(20);
  assertClose([bench.last().captured_micros], [1000 * bench.clock.millis], 1);
});

test("the axes of the view are kept during a grip", () => {
  bench.commander.frame = "view";
  bench.run(1500);
  bench.commander.setJog("keys", FORWARD);
  const before = bench.last().intent;
  bench.eye = new Quaternion(0, 0, Math.SQRT1_2, Math.SQRT1_2);
  bench.run(40);
  assert.deepEqual(bench.last().intent, before);
  bench.commander.setJog("keys", null);
  bench.commander.setJog("keys", FORWARD);
  assert.equal(bench.last().grip, 2);
});

test("a dragged hand is sent as a hand, and does not jump", () => {
  bench.run(1500);
  assert.ok(bench.commander.beginDrag());
  const start = bench.last().intent;
  assert.ok(start?.kind === "hand");
  assert.deepEqual(start.base_from_hand, STATE.base_from_tip);
  bench.commander.dragTo(poseOf([5, 0, 0.4, 0, 0, 0, 1]));
  bench.run(20);
  const { intent } = bench.last();
  assert.ok(intent?.kind === "hand");
  assertClose(intent.base_from_hand.slice(0, 3), [0.5 + 1.5 * 0.02, 0, 0.4], 1e-6);
  bench.commander.endDrag();
  assert.equal(bench.last().grip, null);
});

for (const [name, end] of [
  ["a stop", () => bench.state({ stop: "stopped by operator 3" })],
  ["the end of control", () => bench.state({ holder: 3 })],
  ["a hidden page", () => bench.commander.setHidden(true, bench.clock.millis)],
  ["a lost focus", () => bench.commander.loseEvents("another window has the focus")],
  ["a refused command", () => bench.commander.receive({ type: "refused", request: "command", text: "too old" }, bench.clock.millis)],
  ["a lost link", () => bench.commander.disconnected()],
  ["the own stop", () => bench.commander.stop()],
] as const) {
  test(`${name} ends the grip, says why, and grips again only after a new press`, () => {
    bench.run(1500);
    bench.commander.setPad(PAD);
    bench.commander.setPad({ ...PAD, isHeld: true });
    assert.equal(bench.commander.deadMan.grip, 1);
    end();
    assert.equal(bench.commander.deadMan.grip, null);
    assert.match(bench.notices.at(-1)!, /Released/);
    // The trigger is still pulled when everything is well again.
    bench.commander.receive(ARM, bench.clock.millis);
    bench.commander.setHidden(false, bench.clock.millis);
    const held = { ...PAD, isHeld: true };
    for (let n = 0; n < 80; n++) {
      bench.run(20);
      bench.commander.setPad(held);
    }
    assert.equal(bench.commander.deadMan.grip, null);
    bench.commander.setPad({ ...held, isHeld: false });
    bench.commander.setPad(held);
    assert.equal(bench.commander.deadMan.grip, 2);
  });
}

test("a trigger that is pulled already does not move the arm when control is taken", () => {
  const held = { ...PAD, isHeld: true };
  bench.run(1500, { holder: null });
  bench.commander.setPad(held, false);
  bench.run(100);
  bench.commander.setPad(held);
  assert.equal(bench.commander.deadMan.grip, null);
  bench.commander.setPad(PAD);
  bench.commander.setPad(held);
  assert.equal(bench.commander.deadMan.grip, 1);
});

for (const [name, lose] of [
  ["the page was hidden or without the focus", () => bench.commander.setPad({ ...PAD, isHeld: true }, false)],
  ["the gamepad was away", () => bench.commander.setPad(null)],
] as const) {
  test(`a trigger that is still pulled after ${name} must be released first`, () => {
    bench.run(1500);
    bench.commander.setPad(PAD);
    bench.commander.setPad({ ...PAD, isHeld: true });
    lose();
    assert.equal(bench.last().grip, null, "the release is sent at once");
    bench.commander.setPad({ ...PAD, isHeld: true });
    assert.equal(bench.commander.deadMan.grip, null);
    bench.commander.setPad(PAD);
    bench.commander.setPad({ ...PAD, isHeld: true });
    assert.equal(bench.commander.deadMan.grip, 2);
  });
}

test("the stop button of a gamepad stops the arm also without control, until the server confirms it", () => {
  bench.run(1500, { holder: 3 });
  const stops = (): number => bench.sent.filter(({ type }) => type === "stop").length;
  bench.commander.setPad({ ...PAD, isStop: true }, false);
  assert.equal(stops(), 1);
  bench.state({ holder: 3, stop: "stopped by operator 2", is_moving: true });
  bench.commander.setPad({ ...PAD, isStop: true }, false);
  assert.equal(stops(), 1);
});

test("a recovery can be stopped, with one stop for each press of a gamepad's button", () => {
  const recovering = { stop: "the arm stopped: too hot", stop_number: 1, is_recovering: true };
  bench.run(1500, recovering);
  assert.equal(bench.commander.canMove, true, "motion is permitted when the recovery ends");
  const stops = (): number => bench.sent.filter(({ type }) => type === "stop").length;
  for (const isStop of [true, true, true, false, true]) {
    bench.commander.setPad({ ...PAD, isStop }, false);
    bench.state(recovering);
  }
  assert.equal(stops(), 2);
});

test("after an interruption, the release of one of two keys does not grip again", () => {
  bench.run(1500);
  bench.commander.setJog("keys", FORWARD);
  bench.commander.interrupt("the goal was discarded");
  assert.equal(bench.last().grip, null);
  bench.commander.setJog("keys", { kind: "tip", deflection: { ...NO_DEFLECTION, right: 1 } });
  assert.equal(bench.commander.deadMan.grip, null);
  bench.commander.setJog("keys", null);
  bench.commander.setJog("keys", FORWARD);
  assert.equal(bench.commander.deadMan.grip, 2);
});

test("notices say what to do: hold again only if that has an effect, and the emergency stop without a link", () => {
  bench.run(1500);
  bench.commander.setJog("keys", FORWARD);
  bench.commander.loseEvents("another window has the focus");
  assert.equal(bench.notices.at(-1), "Released: another window has the focus. Let go and hold again");
  bench.commander.setJog("keys", FORWARD);
  bench.state({ stop: "stopped by operator 3" });
  assert.equal(bench.notices.at(-1), "Released: stopped by operator 3");
  bench.commander.disconnected();
  bench.commander.stop();
  assert.match(bench.notices.at(-1)!, /not sent.*emergency stop/);
});

test("a busy page and a silent server end the grip", () => {
  bench.run(1500);
  bench.commander.setJog("keys", FORWARD);
  bench.run(100);
  bench.clock.millis += 400;
  bench.commander.tick(bench.clock.millis);
  assert.equal(bench.commander.deadMan.grip, null);
  bench.commander.setJog("keys", null);
  bench.run(100);
  bench.commander.setJog("keys", FORWARD);
  assert.equal(bench.commander.deadMan.grip, 2);
  for (let n = 0; n < 60; n++) {
    bench.clock.millis += 20;
    bench.commander.tick(bench.clock.millis);
  }
  assert.equal(bench.commander.deadMan.grip, null);
  assert.equal(bench.commander.hasControl, false);
});

test("over a slow link, inputs move a goal, and only go moves the arm", () => {
  bench.roundTripMillis = 150;
  bench.run(2000);
  assert.equal(bench.commander.mode, "preview");
  bench.commander.setJog("button", { kind: "joint", ix: 0, direction: 1 });
  bench.run(200);
  bench.commander.setJog("button", null);
  assert.equal(bench.last().grip, null);
  const question = bench.sent.filter((request) => request.type === "preview").at(-1)!;
  assert.ok("position" in question);
  assertClose(question.position, [0.1 + 0.3 * 0.5 * 2 * 0.2, 0.2], 0.1);
  bench.commander.setGo(true);
  assert.equal(bench.commander.deadMan.grip, null, "the answer is missing");
  bench.commander.setGo(false);
  bench.run(2200); // The answer to the first question is lost.
  const asked = bench.sent.filter((request) => request.type === "preview").at(-1)!;
  const answer: SteerMessage = { type: "preview", id: asked.id, verdict: "reachable", text: "", position: [0.15, 0.2], place: null };
  bench.commander.receive(answer, bench.clock.millis);
  bench.commander.setGo(true);
  const first = bench.last();
  assert.equal(first.grip, 1);
  assert.deepEqual(first.intent, { kind: "joints", position: [0.15, 0.2] }, "the server refuses a grip without intent");
  bench.run(40);
  assert.equal(bench.last().grip, 1);
  assert.deepEqual(bench.last().intent, { kind: "joints", position: [0.15, 0.2] });
  bench.commander.setGo(false);
  assert.equal(bench.last().grip, null);
});

test("a trigger and the button go move the arm to the goal, sticks discard the goal", () => {
  bench.run(1500);
  const held = { isHeld: true, isGo: false, isStop: false, isSwitch: false, deflection: NO_DEFLECTION };
  const preview = (): void => {
    bench.commander.preview([0.15, 0.2]);
    bench.run(120);
    const asked = bench.sent.filter((request) => request.type === "preview").at(-1)!;
    bench.commander.receive({ type: "preview", id: asked.id, verdict: "near", text: "", position: [0.15, 0.2], place: null }, bench.clock.millis);
  };
  preview();
  bench.commander.setPad(PAD);
  bench.commander.setPad(held);
  bench.commander.setPad({ ...held, isGo: true });
  bench.run(40);
  assert.equal(bench.commander.deadMan.source, "pad go");
  assert.deepEqual(bench.last().intent, { kind: "joints", position: [0.15, 0.2] });
  bench.commander.setPad({ ...held, isHeld: false });
  assert.equal(bench.last().grip, null);
  assert.ok(bench.commander.goal.target, "the arm is not there yet");
  bench.commander.setPad(held);
  bench.commander.setPad({ ...held, deflection: { ...NO_DEFLECTION, up: 1 } });
  assert.equal(bench.commander.goal.target, null);
  assert.equal(bench.last().intent?.kind, "tip_velocity");
});

test("a goal is forgotten once the arm is there and go is released", () => {
  bench.run(1500);
  bench.commander.preview([0.15, 0.2]);
  bench.run(120);
  const asked = bench.sent.filter((request) => request.type === "preview").at(-1)!;
  bench.commander.receive({ type: "preview", id: asked.id, verdict: "reachable", text: "", position: [0.15, 0.2], place: null }, bench.clock.millis);
  bench.commander.setGo(true);
  bench.run(100, { position: [0.15, 0.2] });
  assert.ok(bench.commander.goal.target, "the arm is held there");
  bench.commander.setGo(false);
  bench.run(40, { position: [0.15, 0.2] });
  assert.equal(bench.commander.goal.target, null);
});

test("a goal that changes while the arm moves to it ends the motion", () => {
  bench.run(1500);
  bench.commander.preview([0.15, 0.2]);
  bench.run(120);
  const asked = bench.sent.filter((request) => request.type === "preview").at(-1)!;
  bench.commander.receive({ type: "preview", id: asked.id, verdict: "reachable", text: "", position: [0.15, 0.2], place: null }, bench.clock.millis);
  bench.commander.setGo(true);
  assert.equal(bench.last().grip, 1);
  bench.commander.preview([0.5, 0.2]);
  assert.equal(bench.last().grip, null);
});

test("a link that becomes slow ends a grip in servo mode", () => {
  bench.run(1500);
  bench.commander.setJog("keys", FORWARD);
  bench.run(100);
  bench.roundTripMillis = 400;
  bench.run(1000);
  assert.equal(bench.commander.mode, "preview");
  assert.equal(bench.commander.deadMan.grip, null);
  assert.match(bench.notices.at(-1)!, /slow/);
});

test("what was pressed in preview mode does not move the arm when the link becomes fast", () => {
  bench.roundTripMillis = 150;
  bench.run(2000);
  const held = { isHeld: true, isGo: false, isStop: false, isSwitch: false, deflection: NO_DEFLECTION };
  bench.commander.setPad(held);
  bench.commander.setPad({ ...held, isHeld: false });
  bench.roundTripMillis = 10;
  bench.run(4000);
  bench.commander.previewsAlways = true;
  bench.commander.setPad(PAD);
  bench.commander.setPad(held);
  bench.commander.previewsAlways = false;
  bench.commander.setPad(held);
  assert.equal(bench.commander.mode, "servo");
  assert.equal(bench.commander.deadMan.grip, null);
});

test("a hidden page keeps control for a while, and an unused one, too", () => {
  bench.run(1500);
  bench.sent.length = 0;
  bench.commander.setHidden(true, bench.clock.millis);
  bench.run(20_000);
  assert.ok(bench.sent.some((request) => request.type === "lease" && request.action === "renew"));
  assert.equal(bench.commands().filter(({ grip }) => grip !== null).length, 0);
  bench.run(15_000);
  assert.ok(bench.sent.some((request) => request.type === "lease" && request.action === "release"));
});

test("control that is not used is given back", () => {
  bench.run(1500);
  bench.commander.used(bench.clock.millis);
  bench.run(4 * 60_000);
  assert.ok(!bench.sent.some((request) => request.type === "lease"));
  bench.run(2 * 60_000);
  assert.ok(bench.sent.some((request) => request.type === "lease" && request.action === "release"));
});

test("the time from hand to joint is that of own commands, and disappears when it is old", () => {
  bench.run(200);
  const applied = { device: DEVICE, sequence: 1, captured_micros: 2e6, applied_micros: 2.042e6 };
  bench.state({ time_micros: 2.05e6, applied: { ...applied, device: 1 } });
  assert.equal(bench.commander.handToJointMillis, null);
  bench.state({ time_micros: 2.05e6, applied });
  bench.state({ time_micros: 2.06e6, applied });
  assertClose([bench.commander.handToJointMillis!], [42], 1e-9);
  bench.state({ time_micros: 9e6, applied });
  assert.equal(bench.commander.handToJointMillis, null);
});

test("everybody needs the stop button while somebody has control or the arm moves", () => {
  bench.state({ holder: null });
  assert.equal(bench.commander.canMove, false);
  bench.state({ holder: 3 });
  assert.equal(bench.commander.canMove, true);
  bench.state({ holder: CLIENT, stop: "stopped" });
  assert.equal(bench.commander.canMove, false);
  bench.state({ holder: null, is_moving: true });
  assert.equal(bench.commander.canMove, true);
});

const BASE_STATE = { world_from_base: [0, 0, 0.5], goal: null, has_arrived: false, is_moving: false } satisfies SteerState["base"];

/** A bench whose server steers a base. */
function withBase(): Partial<SteerState> {
  bench.commander.receive(BASE, bench.clock.millis);
  bench.commander.frame = "view";
  const state = { position: [], base: BASE_STATE };
  bench.run(1500, state);
  return state;
}

test("a base is driven with the same switch, in its own frame, also over a slow link", () => {
  bench.roundTripMillis = 400;
  const state = withBase();
  assert.equal(bench.commander.mode, "servo");
  bench.commander.setJog("keys", { kind: "tip", deflection: { ...NO_DEFLECTION, forward: 1, right: 1 } });
  bench.run(100, state);
  const { intent, grip } = bench.last();
  assert.equal(grip, 1);
  // It cannot move sideways, so it turns to the right.
  assert.deepEqual(intent, { kind: "base_velocity", forward_m_s: 0.5 * 0.3, left_m_s: 0, yaw_rad_s: -0.3 });
  bench.commander.setJog("keys", null);
  assert.equal(bench.last().grip, null);
  assert.equal(bench.commander.gizmo, null, "there is no hand");
});

test("all inputs move the chosen one of arm and base, and a choice lets go of the other", () => {
  bench.commander.receive(BOTH, bench.clock.millis);
  const state = { base: BASE_STATE };
  bench.run(1500, state);
  const { commander } = bench;
  assert.equal(commander.part, "arm");
  commander.setJog("keys", FORWARD);
  bench.run(60, state);
  assert.equal(bench.last().intent?.kind, "tip_velocity");
  commander.choosePart("base");
  assert.equal(bench.last().grip, null, "the grip moved the arm");
  bench.run(60, state);
  assert.equal(bench.last().grip, null, "the key is still down, but was pressed for the arm");
  commander.setJog("keys", null);
  commander.setJog("keys", FORWARD);
  bench.run(60, state);
  assert.deepEqual(bench.last().intent, { kind: "base_velocity", forward_m_s: 0.5 * 0.3, left_m_s: 0, yaw_rad_s: 0 });
  assert.equal(commander.gizmo, null, "the hand cannot be dragged meanwhile");
  commander.setJog("keys", null);
  // The upper button of a gamepad switches, but not while a trigger is held.
  commander.setPad({ ...PAD, isSwitch: true });
  assert.equal(commander.part, "arm");
  commander.setPad({ ...PAD, isSwitch: true });
  assert.equal(commander.part, "arm", "it is still down");
  commander.setPad(PAD);
  commander.setPad({ ...PAD, isHeld: true, isSwitch: true });
  assert.equal(commander.part, "arm");
});

test("stowing makes the stowed posture the goal of the arm", () => {
  bench.commander.receive(BOTH, bench.clock.millis);
  bench.run(1500, { base: BASE_STATE });
  bench.commander.choosePart("base");
  bench.commander.stow();
  assert.equal(bench.commander.part, "arm");
  const { target } = bench.commander.goal;
  assert.deepEqual(target?.kind === "joints" && target.position, [0, 0.1]);
});

test("a base goes to its goal while go is held, and the goal is done after the release there", () => {
  const state = withBase();
  const { commander } = bench;
  commander.setBaseGoal([2, 0, 0]);
  assert.ok(!commander.mayGoToBaseGoal, "it is outside the area");
  commander.setGo(true);
  assert.equal(bench.last().grip, null);
  commander.setGo(false);
  commander.setBaseGoal([0.5, -0.5, 1]);
  commander.setGo(true);
  bench.run(100, state);
  assert.deepEqual(bench.last().intent, { kind: "base_goal", x_m: 0.5, y_m: -0.5, heading_rad: 1 });
  bench.run(40, { ...state, base: { ...BASE_STATE, has_arrived: true } });
  assert.notEqual(commander.baseGoal, null, "it is still held");
  commander.setGo(false);
  bench.run(40, state);
  assert.equal(commander.baseGoal, null);
});

test("another goal opens the switch, and lost control removes it", () => {
  const state = withBase();
  const { commander } = bench;
  commander.setBaseGoal([0.5, 0, 0]);
  commander.setGo(true);
  bench.run(40, state);
  assert.notEqual(bench.last().grip, null);
  commander.setBaseGoal([0.6, 0, 0]);
  assert.equal(bench.last().grip, null);
  bench.run(40, { ...state, holder: 3 });
  assert.equal(commander.baseGoal, null);
});
