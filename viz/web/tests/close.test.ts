import assert from "node:assert/strict";
import { test } from "node:test";
import { assertClose, fakeClock } from "./close";

test("the comparison rejects different numbers, lengths and NaN", () => {
  assertClose([1, 2.05], [1, 2], 0.1);
  assert.throws(() => assertClose([1, 2.2], [1, 2], 0.1));
  assert.throws(() => assertClose([1], [1, 2], 0.1));
  assert.throws(() => assertClose([Number.NaN], [1], 0.1));
  assert.throws(() => assertClose([1], [Number.NaN], 0.1));
});

test("the clock stands still until it is set", (context) => {
  const clock = fakeClock(context);
  assert.equal(performance.now(), 0);
  clock.millis = 1234;
  assert.equal(performance.now(), 1234);
});
