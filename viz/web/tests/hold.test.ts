import assert from "node:assert/strict";
import { test } from "node:test";
import { HOLD_MILLIS, isHold } from "../src/panels/hold";

test("a finger that waits for the answer holds the control", () => {
  assert.ok(isHold({ pressedMillis: 1000, releasedMillis: 1000 + HOLD_MILLIS, isAnswered: true }));
  assert.ok(isHold({ pressedMillis: 1000, releasedMillis: 4000, isAnswered: true }));
});

test("a tap stays a tap if the page was busy between its two events", () => {
  // The timer has fired before the listener of the release, which was already waiting.
  assert.ok(!isHold({ pressedMillis: 1000, releasedMillis: 1080, isAnswered: true }));
  assert.ok(!isHold({ pressedMillis: 1000, releasedMillis: 1000 + HOLD_MILLIS - 1, isAnswered: true }));
});

test("a long press on a page that shows no answer is a tap", () => {
  assert.ok(!isHold({ pressedMillis: 1000, releasedMillis: 3000, isAnswered: false }));
});
