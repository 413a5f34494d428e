import assert from "node:assert/strict";
import { test } from "node:test";
import { DeadMan } from "../src/steering/dead_man";

function permitted(): DeadMan {
  const deadMan = new DeadMan(() => undefined);
  deadMan.permit(true, "");
  return deadMan;
}

test("nothing is held before it is permitted, also if it is pressed then", () => {
  const deadMan = new DeadMan(() => undefined);
  assert.equal(deadMan.press("keys"), false);
  deadMan.permit(true, "");
  assert.equal(deadMan.grip, null);
  assert.equal(deadMan.press("keys"), false, "the same press");
  deadMan.release("keys");
  assert.equal(deadMan.press("keys"), true);
  assert.equal(deadMan.grip, 1);
});

test("each press is a new grip, and changes are reported", () => {
  const grips: (number | null)[] = [];
  const deadMan: DeadMan = new DeadMan(() => grips.push(deadMan.grip));
  deadMan.permit(true, "");
  for (let n = 0; n < 2; n++) {
    deadMan.press("gizmo");
    deadMan.press("gizmo");
    deadMan.release("gizmo");
  }
  assert.deepEqual(grips, [1, null, 2, null]);
  assert.equal(deadMan.reason, "");
});

test("only one source holds the switch, and the other one does not take over", () => {
  const deadMan = permitted();
  deadMan.press("pad");
  assert.equal(deadMan.press("keys"), false);
  deadMan.release("keys");
  assert.equal(deadMan.source, "pad");
  deadMan.press("keys");
  deadMan.release("pad");
  assert.equal(deadMan.grip, null);
});

test("a grip that was ended does not continue", () => {
  const deadMan = permitted();
  deadMan.press("gizmo");
  deadMan.permit(false, "the arm was stopped");
  assert.equal(deadMan.grip, null);
  assert.equal(deadMan.reason, "the arm was stopped");
  deadMan.permit(true, "");
  assert.equal(deadMan.press("gizmo"), false, "still the same press");
  deadMan.release("gizmo");
  assert.equal(deadMan.press("gizmo"), true);
  assert.equal(deadMan.grip, 2);
});

test("after lost events, pointers and keys can be pressed again; a gamepad that is still pulled must be released", () => {
  const deadMan = permitted();
  deadMan.press("pad");
  deadMan.press("keys");
  deadMan.loseEvents("the page is hidden");
  assert.equal(deadMan.grip, null);
  assert.equal(deadMan.press("pad"), false);
  assert.equal(deadMan.press("keys"), true);
});

test("a pause between two samples ends the grip", () => {
  const deadMan = permitted();
  deadMan.tick(0, 120);
  deadMan.press("gizmo");
  deadMan.tick(5000, 120);
  assert.equal(deadMan.grip, 1, "the pause before the grip does not count");
  deadMan.tick(5100, 120);
  assert.equal(deadMan.grip, 1);
  deadMan.tick(5300, 120);
  assert.equal(deadMan.grip, null);
  assert.match(deadMan.reason, /busy for 200 ms/);
});

test("a source that may not hold the switch at its press does not hold it later", () => {
  const deadMan = permitted();
  assert.equal(deadMan.press("pad", false), false);
  assert.equal(deadMan.press("pad"), false);
  deadMan.release("pad");
  assert.equal(deadMan.press("pad"), true);
});
