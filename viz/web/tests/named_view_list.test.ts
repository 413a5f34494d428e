import assert from "node:assert/strict";
import { test } from "node:test";
import {
  freeName,
  MAX_NAME_LENGTH,
  MAX_NAMED_VIEWS,
  type NamedView,
  namedViewsIn,
  renamed,
  withView,
} from "../src/view/named_view_list";

const TEXT = "1~p1_2_3~t0_0_0~f50";
const OTHER = "1~p3_2_1~t0_0_0~f50";

function views(...names: string[]): NamedView[] {
  return names.map((name) => ({ name, text: TEXT }));
}

test("a stored list returns, and damaged or foreign entries are left out", () => {
  const list = views("door", "rack");
  assert.deepEqual(namedViewsIn(JSON.stringify(list)), list);
  const foreign = [null, 3, "door", [], {}, { name: 1, text: TEXT }, { name: "a", text: "x" }, { name: " b", text: TEXT }, { name: "", text: TEXT }];
  assert.deepEqual(namedViewsIn(JSON.stringify([...foreign, ...list])), list);
  for (const stored of [null, "", "{", "{}", "null", '"door"']) assert.deepEqual(namedViewsIn(stored), [], String(stored));
  const many = JSON.stringify(Array.from({ length: 2 * MAX_NAMED_VIEWS }, (_, ix) => ({ name: `n${ix}`, text: TEXT })));
  assert.equal(namedViewsIn(many).length, MAX_NAMED_VIEWS);
});

test("a view of the same name is replaced in its place", () => {
  const changed = withView(views("door", "rack"), { name: " door ", text: OTHER });
  assert.deepEqual(changed, [{ name: "door", text: OTHER }, { name: "rack", text: TEXT }]);
});

test("a list has a bounded length, and names that can be shown", () => {
  const full = views(...Array.from({ length: MAX_NAMED_VIEWS }, (_, ix) => `n${ix}`));
  assert.equal(withView(full, { name: "new", text: TEXT }), null);
  assert.equal(withView(full, { name: "n3", text: OTHER })!.length, MAX_NAMED_VIEWS);
  assert.equal(withView([], { name: "  ", text: TEXT }), null);
  assert.equal(withView([], { name: "x".repeat(999), text: TEXT })![0]!.name.length, MAX_NAME_LENGTH);
});

test("a view gets another name unless that is taken", () => {
  const list = views("door", "rack");
  assert.deepEqual(renamed(list, "door", " gate "), views("gate", "rack"));
  assert.deepEqual(renamed(list, "door", "door"), list);
  assert.equal(renamed(list, "door", "rack"), null);
  assert.equal(renamed(list, "door", " "), null);
});

test("the proposed name is free", () => {
  assert.equal(freeName([]), "View 1");
  assert.equal(freeName(views("View 2")), "View 3");
  assert.equal(freeName(views("View 3", "a")), "View 4");
});
