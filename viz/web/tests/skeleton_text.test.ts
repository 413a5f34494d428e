import assert from "node:assert/strict";
import { test } from "node:test";
import { isNothingShown, type Knowledge, skeletonText } from "../src/panels/skeleton_text";

const OPEN: Knowledge = { connection: "open", status: null, isContextLost: false };

function textIn(state: string, progress?: { text: string; done_frac: number | null; is_startup: boolean }) {
  return skeletonText({ ...OPEN, status: progress ? { state, progress } : { state } });
}

test("before the first status, the text is about the connection", () => {
  assert.equal(skeletonText({ ...OPEN, connection: "connecting" }).title, "Connecting to the server");
  assert.equal(skeletonText({ ...OPEN, connection: "lost" }).title, "No connection to the server");
  assert.match(skeletonText(OPEN).detail, /waiting for the state/);
  assert.match(textIn("").detail, /waiting for the state/);
});

test("the state of the run and its progress are shown", () => {
  const collecting = { text: "3 of 5 keyframes", done_frac: 0.6, is_startup: true };
  assert.deepEqual(textIn("collecting keyframes", collecting), {
    title: "Collecting keyframes",
    detail: "3 of 5 keyframes",
    doneFrac: 0.6,
  });
  assert.equal(textIn("scoring, 12 of 50 images").title, "Scoring, 12 of 50 images");
  assert.equal(textIn("viewing").detail, "drawing the first picture");
  assert.equal(textIn("saving").detail, "a picture follows");
});

test("a lost WebGL context is more important than the state", () => {
  const status = { state: "training" };
  assert.match(skeletonText({ ...OPEN, status, isContextLost: true }).title, /graphics context/);
});

test("the view is covered until something was drawn", () => {
  const nothing = { hasPicture: false, hasContent: false, isStartup: false, isContextLost: false };
  assert.ok(isNothingShown(nothing));
  const empty = { ...nothing, hasPicture: true };
  assert.ok(!isNothingShown(empty), "an operator may look at empty space");
  assert.ok(isNothingShown({ ...empty, isStartup: true }), "there is no model yet");
  const content = { ...empty, hasContent: true };
  assert.ok(!isNothingShown({ ...content, isStartup: true }), "first keyframes with depth can be drawn");
  assert.ok(isNothingShown({ ...content, isContextLost: true }));
});
