import assert from "node:assert/strict";
import { test } from "node:test";
import page from "../src/index.html" with { type: "text" };
import { chordLabel, parseChords } from "../src/key_chord";
import { KEYS } from "../src/key_table";

/** The tags of the buttons in the page, by id. */
const BUTTONS = new Map([...page.matchAll(/<button id="([^"]+)"[^>]*>/g)].map(([tag, id]) => [id!, tag]));

test("every key has one meaning, and a button with a title", () => {
  const keys = Object.values(KEYS).flatMap((text) => parseChords(text).map(chordLabel));
  assert.ok(keys.length > 30);
  assert.deepEqual(keys.filter((key, ix) => keys.indexOf(key) !== ix), []);
  for (const id of Object.keys(KEYS)) assert.match(BUTTONS.get(id) ?? "missing", /title="[^"]+"/, id);
});

test("keys are added to the titles, which contain none", () => {
  for (const id of Object.keys(KEYS)) assert.doesNotMatch(BUTTONS.get(id)!, /\((.|Delete|Ctrl\+.*)\)/, id);
});

test("ids are unique", () => {
  const ids = [...page.matchAll(/ id="([^"]+)"/g)].map(([, id]) => id);
  assert.deepEqual(ids.filter((id, ix) => ids.indexOf(id) !== ix), []);
});
