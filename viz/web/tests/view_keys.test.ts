import assert from "node:assert/strict";
import { test } from "node:test";
import { basicGestures, devicesOf, inTouchWords, isTouchDevice } from "../src/panels/gestures";
import { viewStep, type ViewStep } from "../src/view/view_keys";

function step(key: string, shiftKey = false, ctrlKey = false): ViewStep | null {
  return viewStep({ key, shiftKey, ctrlKey, metaKey: false, altKey: false });
}

test("arrow keys orbit, with Shift they pan, plus and minus zoom", () => {
  assert.deepEqual(step("ArrowLeft"), { kind: "orbit", right: -1, up: 0, closer: 0 });
  assert.deepEqual(step("ArrowUp", true), { kind: "pan", right: 0, up: 1, closer: 0 });
  assert.deepEqual(step("+", true), { kind: "zoom", right: 0, up: 0, closer: 1 });
  assert.deepEqual(step("-"), { kind: "zoom", right: 0, up: 0, closer: -1 });
});

test("other keys and the browser's own zoom do not move the view", () => {
  assert.equal(step("r"), null);
  assert.equal(step("+", false, true), null);
});

test("the help is about the devices of the user", () => {
  const none = { hasFinePointer: false, hasCoarsePointer: false, hasPressedKey: false };
  assert.deepEqual(devicesOf(none), ["mouse", "keyboard"]); // Browsers without a pointer say nothing.
  assert.deepEqual(devicesOf({ ...none, hasCoarsePointer: true }), ["touch"]);
  assert.deepEqual(devicesOf({ ...none, hasCoarsePointer: true, hasPressedKey: true }), ["touch", "keyboard"]);
  assert.deepEqual(devicesOf({ ...none, hasFinePointer: true, hasCoarsePointer: true }), ["mouse", "touch", "keyboard"]);
});

test("texts are about a finger on devices with a touch screen, and after a touch", () => {
  assert.ok(isTouchDevice(null, true, true), "a phone with a mouse");
  assert.ok(isTouchDevice(null, false, false));
  assert.ok(!isTouchDevice(null, false, true), "a laptop with a touch screen");
  assert.ok(isTouchDevice("touch", false, true));
  assert.ok(!isTouchDevice("mouse", true, true));
});

test("texts for a finger have neither clicks nor keys", () => {
  assert.equal(inTouchWords("Click on two points. Delete removes the last distance."), "Tap on two points.");
  assert.equal(inTouchWords("Click on the second point. Esc cancels."), "Tap on the second point.");
  assert.equal(inTouchWords("Show the model. Double-click on it (M)"), "Show the model. Double-tap on it");
  assert.equal(inTouchWords("double-click on another point, or fly (Y)"), "double-tap on another point, or fly");
  assert.equal(inTouchWords("Delete “front”"), "Delete “front”");
});

test("each pointing device has three basic gestures", () => {
  for (const device of ["mouse", "touch"] as const) {
    assert.deepEqual(basicGestures(device).map(([, what]) => what), ["orbit", "pan", "zoom"]);
  }
});
