import assert from "node:assert/strict";
import { test } from "node:test";
import { chordLabel, type Focus, isPressed, keepsKey, parseChords, type Press } from "../src/key_chord";
import { isMovementKey } from "../src/view/movement_keys";

const NO_MODIFIERS = { ctrlKey: false, metaKey: false, altKey: false, shiftKey: false };

function press(key: string, modifiers: Partial<Press> = {}): Press {
  return { key, code: "", ...NO_MODIFIERS, ...modifiers };
}

function matches(chords: string, pressed: Press): boolean {
  return parseChords(chords).some((chord) => isPressed(chord, pressed));
}

test("chords are parsed and labeled", () => {
  const labels = parseChords("0 Home ctrl+shift+z + Ctrl++ ArrowLeft").map(chordLabel);
  assert.deepEqual(labels, ["0", "Home", "Ctrl+Shift+Z", "+", "Ctrl++", "←"]);
});

test("control and command are the same modifier, and others must match", () => {
  assert.ok(matches("Ctrl+Z", press("z", { ctrlKey: true })));
  assert.ok(matches("Ctrl+Z", press("z", { metaKey: true })));
  assert.ok(!matches("Ctrl+Z", press("z")));
  assert.ok(!matches("Ctrl+Z", press("Z", { ctrlKey: true, shiftKey: true })));
  assert.ok(matches("Ctrl+Shift+Z", press("Z", { ctrlKey: true, shiftKey: true })));
  assert.ok(!matches("z", press("z", { ctrlKey: true })));
  assert.ok(!matches("z", press("z", { altKey: true })));
});

test("characters can need Shift or be typed with Shift held, but named keys match exactly", () => {
  assert.ok(matches("?", press("?", { shiftKey: true })));
  assert.ok(matches("r", press("R", { shiftKey: true })));
  assert.ok(matches("Delete", press("Delete")));
  assert.ok(!matches("Delete", press("Delete", { shiftKey: true })));
});

test("keyboards without Latin letters use the same places", () => {
  assert.ok(matches("z", press("я", { code: "KeyZ" })));
  assert.ok(!matches("z", press("y", { code: "KeyZ" }))); // A German keyboard.
  assert.ok(matches("ö", press("ö", { code: "Semicolon" })));
});

test("fields keep the keys of text, sliders and lists only those that change their value", () => {
  const focus = (tag: string, type = ""): Focus => ({ tag, type, isEditable: false });
  const kept = (at: Focus): string => ["v", "arrowup", " ", "escape"].filter((key) => keepsKey(at, key)).join();
  assert.equal(kept(focus("input", "text")), "v,arrowup, ");
  assert.equal(kept(focus("input", "number")), "v,arrowup, ");
  assert.equal(kept({ tag: "div", type: "", isEditable: true }), "v,arrowup, ");
  assert.equal(kept(focus("input", "range")), "arrowup, ");
  assert.equal(kept(focus("select")), "arrowup, ");
  assert.equal(kept(focus("button")), " ");
  assert.equal(kept(focus("canvas")), "");
});

test("only the keys of the fly mode move the eye", () => {
  const moving = ["w", "a", "s", "d", "q", "e", "arrowup", "arrowleft"];
  assert.deepEqual([...moving, "delete", "z", "r", "home"].filter(isMovementKey), moving);
});
