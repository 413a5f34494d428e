import assert from "node:assert/strict";
import { test } from "node:test";
import type { PreviewAnswer } from "../src/steering/messages";
import { isApart, lookOfLimits, lookOfVerdict, LOOKS } from "../src/steering/ghost_looks";
import { Goal } from "../src/steering/goal";
import { composed, integrated, inverse, numbersOf, poseOf, slewed } from "../src/steering/pose";
import { positionsFor, storedPosesIn, withPose } from "../src/steering/stored_poses";
import { leaseText, limitText, modeText, shownLimits, verdictText } from "../src/steering/texts";
import { Quaternion, Vector3 } from "three";
import { assertClose } from "./close";
import { CLIENT, STATE } from "./steering_examples";

function answer(id: number, verdict: PreviewAnswer["verdict"], position: number[] | null): PreviewAnswer {
  return { type: "preview", id, verdict, text: "", position, place: null };
}

function askedId(goal: Goal, nowMillis: number): number {
  const question = goal.question(nowMillis);
  assert.ok(question?.type === "preview");
  return question.id;
}

test("a goal is asked for, and the arm may go only after the answer", () => {
  const goal = new Goal();
  assert.equal(goal.question(0), null);
  goal.set({ kind: "joints", position: [1, 2] });
  assert.deepEqual(goal.question(0), { type: "preview", id: 1, position: [1, 2] });
  assert.equal(goal.question(1000), null, "the answer is awaited");
  assert.equal(goal.intent, null);
  assert.ok(goal.answer(answer(1, "reachable", [1, 2])));
  assert.deepEqual(goal.intent, { kind: "joints", position: [1, 2] });
  assert.equal(goal.question(5000), null, "it is known");
  assert.ok(goal.isReached([1.001, 2]) && !goal.isReached([1.1, 2]) && !goal.isReached([1]));
});

test("the nearest posture to a goal that cannot be reached is not the goal", () => {
  const goal = new Goal();
  goal.set({ kind: "joints", position: [1, 2] });
  goal.answer(answer(askedId(goal, 0), "unreachable", [0.9, 2]));
  assert.equal(goal.isReached([0.9, 2]), false);
});

test("while a goal is dragged, questions are few, and old answers permit nothing", () => {
  const goal = new Goal();
  const set = (x: number): void => goal.set({ kind: "pose", baseFromTip: poseOf([x, 0, 0, 0, 0, 0, 1]) });
  set(1);
  const first = askedId(goal, 0);
  set(2);
  assert.equal(goal.question(50), null);
  assert.ok(goal.answer(answer(first, "reachable", [1, 1])));
  assert.equal(goal.intent, null, "the answer is about another place");
  assert.deepEqual(goal.judgment?.position, [1, 1], "but the ghost is shown there");
  assert.equal(goal.question(60), null, "too early");
  const second = askedId(goal, 120);
  assert.equal(goal.answer(answer(first, "reachable", null)), false);
  assert.ok(goal.answer(answer(second, "reachable", null)));
  assert.deepEqual(goal.intent, { kind: "pose", base_from_tip: [2, 0, 0, 0, 0, 0, 1] });
  set(3);
  assert.equal(goal.intent, null, "the goal has moved");
});

test("a lost answer is asked for again, and goals that are refused have no intent", () => {
  const goal = new Goal();
  goal.set({ kind: "joints", position: [0] });
  askedId(goal, 0);
  assert.equal(goal.question(1900), null);
  const again = askedId(goal, 2100);
  for (const verdict of ["unreachable", "self-collision", "never seen", "limits"] as const) {
    goal.set({ kind: "joints", position: [0] });
    goal.answer(answer(again, verdict, [0]));
    assert.equal(goal.intent, null, verdict);
  }
  goal.clear();
  assert.equal(goal.answer(answer(again, "reachable", [0])), false, "it was given up");
  assert.equal(goal.target, null);
});

test("each look of the ghost has a distinct pattern, and collisions precede nearness", () => {
  const patterns = Object.values(LOOKS).map(({ pattern }) => pattern);
  assert.equal(new Set(patterns).size, patterns.length);
  const looks = (["reachable", "near", "self-collision", "never seen", "unreachable", "limits"] as const).map(lookOfVerdict);
  assert.deepEqual(looks, ["reachable", "near", "collision", "collision", "unreachable", "unreachable"]);
  const limit = { part: "arm", speed_scale: 0.5, text: "", place: null } as const;
  const slowed = { ...limit, link: "clearance", effect: "slowed" } as const;
  const refused = { ...limit, link: "self-collision", effect: "refused" } as const;
  assert.equal(lookOfLimits([]), "reachable");
  assert.equal(lookOfLimits([slowed]), "near");
  assert.equal(lookOfLimits([slowed, refused]), "collision");
  assert.equal(lookOfLimits([{ ...limit, link: "limits", effect: "refused" }]), "unreachable");
  assert.ok(isApart([0, 0.1], [0, 0]) && !isApart([0, 0.001], [0, 0]));
});

test("stored poses belong to joints by name; damaged lists are left out", () => {
  const joints = { shoulder: 0.5, slide: 0.1 };
  const poses = withPose([], { name: " home ", joints })!;
  assert.deepEqual(storedPosesIn(JSON.stringify(poses)), [{ name: "home", joints }]);
  assert.deepEqual(positionsFor(poses[0]!, ["slide", "shoulder"]), [0.1, 0.5]);
  for (const names of [["slide"], ["slide", "elbow"], ["slide", "shoulder", "elbow"], ["slide", "toString"]]) {
    assert.equal(positionsFor(poses[0]!, names), null, names.join());
  }
  const replaced = withPose(poses, { name: "home", joints: { slide: 1 } })!;
  assert.deepEqual(replaced, [{ name: "home", joints: { slide: 1 } }]);
  assert.equal(withPose(poses, { name: "", joints })![1]!.name, "Pose 2");
  for (const text of [null, "{", "7", '[{"name":"a"}]', '[{"name":"a","joints":{"b":"x"}}]', '[{"name":" a","joints":{"b":1}}]']) {
    assert.deepEqual(storedPosesIn(text), [], String(text));
  }
  const full = Array.from({ length: 100 }, (_, ix) => ({ name: `Pose ${ix}`, joints }));
  assert.equal(withPose(full, { name: "one more", joints }), null);
});

test("texts say who has control, and how the arm moves and why", () => {
  assert.equal(leaseText(STATE, CLIENT), "You have control");
  assert.equal(leaseText({ ...STATE, holder: null }, CLIENT), "Nobody has control of the arm");
  const other = { ...STATE, holder: 3, lease_left_secs: 4.2, offered_to: CLIENT };
  assert.equal(leaseText(other, CLIENT), "Operator 3 has control for at least 4 s more. Control is offered to you");
  assert.match(modeText("servo", 32.4, 120, false), /^Servo.*32 ms, limit 120 ms/);
  assert.match(modeText("preview", null, 120, true), /^Preview, then go as chosen.*not measured/);
  const limit = { part: "arm", link: "clearance", speed_scale: 0.25, text: "3 cm to a surface", place: null } as const;
  assert.equal(limitText({ ...limit, effect: "slowed" }), "Slowed to 25 %: 3 cm to a surface");
  assert.equal(limitText({ ...limit, effect: "refused" }), "Refused: 3 cm to a surface");
  assert.equal(verdictText("unreachable", ""), "The goal is out of reach");
});

test("an open switch at rest is no news", () => {
  const clutch = { part: "arm", link: "clutch", effect: "braked", speed_scale: 0, text: "the dead-man switch is open", place: null } as const;
  const clearance = { ...clutch, link: "clearance", effect: "slowed" } as const;
  assert.deepEqual(shownLimits([clutch, clearance], false), [clearance]);
  assert.deepEqual(shownLimits([clutch, clearance], true), [clutch, clearance]);
});

test("a hand is not faster than its limit, and moves straight", () => {
  const [from, to] = [poseOf([0, 0, 0, 0, 0, 0, 1]), poseOf([1, 0, 0, 0, 0, 1, 0])];
  const speed = { metersPerSec: 1, radPerSec: 100 };
  const way = slewed(from, to, 0.1, speed);
  assertClose(way.position.toArray(), [0.1, 0, 0], 1e-9);
  assertClose([way.rotation.angleTo(from.rotation)], [0.1 * Math.PI], 1e-6);
  assertClose(numbersOf(slewed(from, to, 10, speed)), numbersOf(to), 1e-9);
  assertClose(numbersOf(slewed(from, from, 0.1, speed)), numbersOf(from), 1e-12);
});

test("poses compose and invert, and velocities act in axes of the base", () => {
  const pose = { position: new Vector3(1, 2, 3), rotation: new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), Math.PI / 2) };
  const point = { position: new Vector3(1, 0, 0), rotation: new Quaternion() };
  assertClose(composed(pose, point).position.toArray(), [1, 3, 3], 1e-9);
  assertClose(numbersOf(composed(inverse(pose), pose)), [0, 0, 0, 0, 0, 0, 1], 1e-9);
  const moved = integrated(pose, new Vector3(1, 0, 0), new Vector3(0, 0, 0), 0.5);
  assertClose(moved.position.toArray(), [1.5, 2, 3], 1e-9);
  const turned = integrated(pose, new Vector3(), new Vector3(0, 0, Math.PI), 0.5);
  assertClose([turned.rotation.angleTo(pose.rotation)], [Math.PI / 2], 1e-6);
});
