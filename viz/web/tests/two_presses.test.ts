import assert from "node:assert/strict";
import { test } from "node:test";
import { TwoPresses } from "../src/steering/two_presses";

const STOP = 3;

/** Presses at these times. Returns the times of those that count. */
function counted(times: readonly number[], subjects: readonly number[] = []): number[] {
  let millis = 0;
  const presses = new TwoPresses(() => millis);
  return times.filter((time, ix) => {
    millis = time;
    return presses.press(subjects[ix] ?? STOP);
  });
}

test("two deliberate presses count once", () => {
  assert.deepEqual(counted([1000]), []);
  assert.deepEqual(counted([1000, 1400]), [1400]);
  assert.deepEqual(counted([1000, 6000]), [6000]);
  assert.deepEqual(counted([1000, 6001]), [], "the first one is forgotten");
});

test("double clicks and quick presses never count, however many there are", () => {
  assert.deepEqual(counted([1000, 1399]), []);
  assert.deepEqual(counted([1000, 1000]), []);
  const quick = Array.from({ length: 100 }, (_, ix) => 1000 + 300 * ix);
  assert.deepEqual(counted(quick), []);
  // A deliberate press after a double click is the second one.
  assert.deepEqual(counted([1000, 1100, 1600]), [1600]);
  // A double click is not a second and a third press.
  assert.deepEqual(counted([1000, 1500, 1600, 1700]), [1500]);
});

test("after both presses, the next permission needs two again", () => {
  assert.deepEqual(counted([1000, 1500, 2000, 2500]), [1500, 2500]);
});

test("a new stop between the presses begins anew", () => {
  assert.deepEqual(counted([1000, 1500], [STOP, STOP + 1]), []);
  assert.deepEqual(counted([1000, 1500, 2000], [STOP, STOP + 1, STOP + 1]), [2000]);
});

test("the page asks for the second press while it would count", () => {
  let millis = 0;
  const presses = new TwoPresses(() => millis);
  assert.equal(presses.isAwaited(STOP), false);
  presses.press(STOP);
  assert.equal(presses.isAwaited(STOP), true);
  assert.equal(presses.isAwaited(STOP + 1), false, "of another stop");
  assert.equal(presses.isAwaited(null), false, "the stop has ended");
  millis = 5001;
  assert.equal(presses.isAwaited(STOP), false);
});
