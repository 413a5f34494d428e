import assert from "node:assert/strict";
import { test } from "node:test";
import { Governor, LADDER, predictedPx, QUEST_3_PX_PER_SEC, qualityText } from "../src/headset/governor";
import { EXTENTS, FillSum, meanShadow, reachOf } from "../src/layers/splat_fill";

const HZ = 72;
const PERIOD_MILLIS = 1000 / HZ;
/** Covered pixels per eye that the simulated headset draws in one frame. */
const CAPACITY_PX = 5e6;

/** A headset whose frames take as long as the splats cover, in whole periods of its display. */
class SimulatedHeadset {
  readonly governor = new Governor(HZ);
  nowMillis = 0;
  nMissed = 0;

  constructor(private readonly capacityPx: number) {}

  run(millis: number, coveredPx: number[]): void {
    const end = this.nowMillis + millis;
    while (this.nowMillis < end) {
      this.governor.setCovered(coveredPx);
      // No frame of a test takes longer than a third of a second.
      const nPeriods = Math.min(24, Math.max(1, Math.ceil(this.governor.fill / this.capacityPx)));
      this.nowMillis += nPeriods * PERIOD_MILLIS;
      this.nMissed += nPeriods - 1;
      this.governor.frame(this.nowMillis);
    }
  }
}

/** Covered pixels by extent, of splats with a high opacity. */
function covered(wholePx: number): number[] {
  return EXTENTS.map((extent) => (wholePx * extent) / EXTENTS[0]!);
}

test("each step of the ladder costs less than the one before, and the last one nothing", () => {
  const costs = LADDER.map((quality) => predictedPx(covered(1e6), quality));
  for (let ix = 1; ix < costs.length; ix++) assert.ok(costs[ix]! < costs[ix - 1]!, `step ${ix}: ${costs}`);
  assert.equal(costs.at(-1), 0);
});

test("the extent is lowered first, then the viewport, the foveation, and the number last", () => {
  const first = (isLower: (quality: (typeof LADDER)[number]) => boolean): number => LADDER.findIndex(isLower);
  const steps = [
    first(({ maxReach }) => maxReach < EXTENTS[0]!),
    first(({ viewportScale }) => viewportScale < 1),
    first(({ foveation }) => foveation > 0),
    first(({ share }) => share < 1),
    first(({ usesServer }) => usesServer),
  ];
  assert.deepEqual(steps, [...steps].sort((a, b) => a - b));
  assert.ok(steps.every((step) => step > 0));
});

test("the budget at the start is that of a Quest 3, and five views get the quality that fits", () => {
  const governor = new Governor(HZ);
  const budget = (0.7 * QUEST_3_PX_PER_SEC) / HZ / 2;
  assert.ok(Math.abs(governor.budget - budget) < 1e-6 * budget);
  // Covered pixels of one eye with 2 Mpx: far away, on a table, the face in the splats, a wall, and the sky.
  const views = { far: 0.3e6, table: 4e6, face: 60e6, wall: 15e6, sky: 0 };
  const steps = Object.entries(views).map(([name, px]) => {
    const own = new Governor(HZ);
    own.setCovered(covered(px));
    for (let ms = 0; ms < 100; ms += PERIOD_MILLIS) own.frame(ms);
    assert.ok(own.fill <= own.budget, `${name}: ${own.fill} of ${own.budget}`);
    return own.step;
  });
  const [far, table, face, wall, sky] = steps as [number, number, number, number, number];
  assert.equal(far, 0);
  assert.equal(sky, 0);
  assert.equal(table, 0);
  assert.ok(wall > 0 && face > wall, `${steps}`);
});

test("missed frames lower the quality until the frame rate holds, whatever the headset is believed to draw", () => {
  const headset = new SimulatedHeadset(1e6);
  headset.run(3000, covered(4e6));
  headset.nMissed = 0;
  headset.run(400, covered(4e6));
  assert.ok(headset.nMissed <= 2, `${headset.nMissed} missed frames`);
  assert.ok(headset.governor.step > 0 && !headset.governor.quality.usesServer);
});

test("the full quality returns within 2 s after the load has gone", () => {
  const headset = new SimulatedHeadset(CAPACITY_PX);
  headset.run(500, covered(2e6));
  assert.equal(headset.governor.step, 0);
  headset.run(3000, covered(100e6));
  assert.ok(headset.governor.step > 3, `step ${headset.governor.step}`);
  headset.run(2000, covered(2e6));
  assert.equal(headset.governor.step, 0);
});

test("a load that never fits ends with pictures of the server", () => {
  const headset = new SimulatedHeadset(1e4);
  headset.run(3000, covered(200e6));
  assert.ok(headset.governor.quality.usesServer);
});

test("quality does not flicker under a constant load", () => {
  const headset = new SimulatedHeadset(CAPACITY_PX);
  headset.run(8000, covered(9e6));
  const steps: number[] = [];
  for (let ix = 0; ix < 40; ix++) {
    headset.run(100, covered(9e6));
    steps.push(headset.governor.step);
  }
  const nChanges = steps.filter((step, ix) => ix > 0 && step !== steps[ix - 1]).length;
  assert.ok(nChanges <= 8, `${steps}`);
});

test("a pause of the session is no missed frame", () => {
  const governor = new Governor(HZ);
  governor.setCovered(covered(1e6));
  governor.frame(0);
  const { budget } = governor;
  governor.frame(5000);
  assert.equal(governor.budget, budget);
});

test("the operator's choice overrides the governor", () => {
  const governor = new Governor(HZ);
  governor.fixed = 5;
  governor.setCovered(covered(1e9));
  for (let ms = 0; ms < 1000; ms += PERIOD_MILLIS) governor.frame(ms);
  assert.equal(governor.step, 5);
  assert.match(qualityText(governor.quality), /2\.0 sigma, 70 % resolution/);
});

test("the mean shadow of a ball is its disk, and that of a flat disk half of it", () => {
  assert.ok(Math.abs(meanShadow([2, 2, 2]) / (4 * Math.PI) - 1) < 1e-12);
  // A quarter of both sides. The approximation is exact to 1.1 %.
  assert.ok(Math.abs(meanShadow([1, 1, 0]) / (0.5 * Math.PI) - 1) < 0.011);
});

test("the extents begin with that of an opaque splat", () => {
  assert.equal(EXTENTS[0], reachOf(255));
  assert.equal(reachOf(1), 0);
  assert.equal(reachOf(0), 0);
});

test("covered pixels are those of an ellipse, cut at the picture, and none behind the eye", () => {
  const lens = { sizePx: [400, 300] as [number, number], focalPx: [200, 200] as [number, number], principalPx: [200, 150] as [number, number], nearM: 0.05 };
  const one = (x: number, y: number, z: number, sigma: number): number[] => {
    const fill = new FillSum(lens);
    fill.add(x, y, z, meanShadow([sigma, sigma, sigma]), reachOf(255));
    return fill.coveredPx;
  };
  const sigmaPx2 = (0.02 * 100) ** 2 + 0.3; // 0.02 m at 2 m.
  const expected = Math.PI * reachOf(255) * sigmaPx2;
  assert.ok(Math.abs(one(0, 0, 2, 0.02)[0]! - expected) < 1e-9 * expected);
  assert.ok(Math.abs(one(0, 0, 2, 0.02)[3]! - (expected * 4) / reachOf(255)) < 1e-9 * expected);
  assert.ok(Math.abs(one(2, 0, 2, 0.02)[0]! - 0.5 * expected) < 1e-9 * expected, "half of it at the right edge");
  assert.equal(one(0, 0, -1, 0.02)[0], 0);
  assert.equal(one(5, 0, 2, 0.02)[0], 0, "outside");
  assert.ok(one(0, 0, 0.1, 1)[0]! <= 400 * 300, "not more than the picture");
});
