import assert from "node:assert/strict";
import { test } from "node:test";
import { draggedGoal, goalIntent, isInArea } from "../src/steering/floor_goal";
import { assertClose } from "./close";

test("a goal faces the direction of the drag, and keeps the heading of the base without one", () => {
  assert.deepEqual(draggedGoal([1, 2], [1, 2], 0.5), [1, 2, 0.5]);
  assert.deepEqual(draggedGoal([1, 2], [1.05, 2], 0.5), [1, 2, 0.5]);
  assertClose(draggedGoal([1, 2], [1, 3], 0.5), [1, 2, Math.PI / 2], 1e-12);
  assertClose(draggedGoal([1, 2], [0, 2], 0.5), [1, 2, Math.PI], 1e-12);
});

test("only goals in the area may be sent", () => {
  const area: [number, number, number, number] = [-1, 0, 1, 2];
  assert.ok(isInArea([1, 2, 7], area));
  assert.ok(!isInArea([1.1, 1, 0], area));
  assert.ok(!isInArea([0, -0.1, 0], area));
  assert.ok(isInArea([99, 99, 0], null));
  assert.deepEqual(goalIntent([1, 2, 3]), { kind: "base_goal", x_m: 1, y_m: 2, heading_rad: 3 });
});
