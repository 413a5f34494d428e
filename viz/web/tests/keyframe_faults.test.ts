import assert from "node:assert/strict";
import { test } from "node:test";
import type { KeyframeErrors } from "../src/panels/keyframe_error";
import { keyframeFaults, type KeyframeFacts, poseDifference } from "../src/panels/keyframe_faults";
import { durationText } from "../src/panels/quantities";
import { assertClose } from "./close";

const GOOD: KeyframeErrors = {
  map: new Float32Array(1),
  psnr: 31,
  exposureEv: 0.05,
  detailRatio: 1.1,
  shiftPx: null,
  worst: null,
  emptyFrac: 0,
};
const FACTS: KeyframeFacts = { correction: { meters: 0.0005, radians: 0.001 }, ageSecs: 5, turnRadS: 0.1 };

test("a good keyframe has no fault, and neither has an unknown one", () => {
  assert.deepEqual(keyframeFaults(GOOD, FACTS), []);
  assert.deepEqual(keyframeFaults(null, { correction: null, ageSecs: null, turnRadS: null }), []);
});

test("each fault is named", () => {
  const faults = (errors: Partial<KeyframeErrors>, facts: Partial<KeyframeFacts> = {}): string[] =>
    keyframeFaults({ ...GOOD, ...errors }, { ...FACTS, ...facts });
  assert.deepEqual(faults({ detailRatio: 0.4 }), ["blurred"]);
  assert.deepEqual(faults({ detailRatio: 0.4 }, { turnRadS: 0.7 }), [
    "blurred: the camera turned by 40 degrees per second",
  ]);
  assert.match(faults({ detailRatio: 3 })[0]!, /^the model lacks detail/);
  assert.deepEqual(faults({}, { correction: { meters: 0.008, radians: 0.001 } }), [
    "pose corrected by 8.0 mm and 0.06 degrees",
  ]);
  const upperLeft = { name: "upper left", meanError: 0.3 };
  assert.match(faults({ worst: upperLeft })[0]!, /^large error in the upper left: did something move/);
  assert.deepEqual(faults({ worst: upperLeft, detailRatio: 0.4 }), ["large error in the upper left", "blurred"]);
  assert.deepEqual(faults({ exposureEv: -0.42 }), ["exposure differs by 0.4 EV: the photograph is darker"]);
  assert.deepEqual(faults({}, { ageSecs: 240 }), ["old: 4 min"]);
  assert.match(faults({ shiftPx: [4.2, -1] })[0]!, /^shifted by 4.2 px to the right and 1.0 px up/);
  assert.deepEqual(faults({ emptyFrac: 0.3 }), ["the model is empty in 30 % of the picture"]);
});

test("a large error without a known cause is not passed over", () => {
  assert.match(keyframeFaults({ ...GOOD, psnr: 14 }, FACTS)[0]!, /^large error everywhere \(14.0 dB\)/);
  assert.deepEqual(keyframeFaults({ ...GOOD, psnr: 14, detailRatio: 0.4 }, FACTS), ["blurred"]);
});

test("the difference of poses is a distance and an angle", () => {
  const cosine = Math.cos(0.3);
  const sine = Math.sin(0.3);
  const turned = [cosine, -sine, 0, 1, sine, cosine, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1];
  const moved = [1, 0, 0, 1, 0, 1, 0, 2.03, 0, 0, 1, 3.04, 0, 0, 0, 1];
  const { meters, radians } = poseDifference(turned, moved);
  assertClose([meters, radians], [0.05, 0.3], 1e-9);
  assert.equal(poseDifference(turned, turned).meters, 0);
});

test("durations are rounded to what matters", () => {
  assert.deepEqual([4.25, 42.4, 240, 9000].map(durationText), ["4.3 s", "42 s", "4 min", "2.5 h"]);
});
