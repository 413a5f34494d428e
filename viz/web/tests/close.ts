// Comparison of numbers, and a clock for tests.

import assert from "node:assert/strict";
import type { TestContext } from "node:test";

/** Fails unless there are as many numbers as expected, and none differs by more than the tolerance. */
export function assertClose(actual: ArrayLike<number>, expected: ArrayLike<number>, tolerance: number): void {
  const [found, wanted] = [Array.from(actual), Array.from(expected)];
  assert.equal(found.length, wanted.length, `${found.length} numbers, expected ${wanted.length}`);
  // Written so that a NaN is not close to anything.
  const isClose = found.every((value, ix) => Math.abs(value - wanted[ix]!) <= tolerance);
  assert.ok(isClose, `[${found.join(", ")}] differs from [${wanted.join(", ")}] by more than ${tolerance}`);
}

/** Replaces the page's clock until the end of a test. */
export function fakeClock(context: TestContext): { millis: number } {
  const clock = { millis: 0 };
  context.mock.method(performance, "now", () => clock.millis);
  return clock;
}
