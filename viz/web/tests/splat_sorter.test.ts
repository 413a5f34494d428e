import assert from "node:assert/strict";
import { test } from "node:test";
import { SplatSorter, UNIT_SPLATS } from "../src/layers/splat_sorter";

const MIN_M: [number, number, number] = [-1, -2, -3];
const MAX_M: [number, number, number] = [1, 2, 5];
const MEAN_MAX = 8191;
/** Sizes have no effect on the order. */
const SCALES = { minLogScale: -5, logScaleStep: 0.01 };

/** Words of splats with these quantized means; color and shape are not used for sorting. */
function wordsOf(means: [number, number, number][]): Uint32Array<ArrayBuffer> {
  const words = new Uint32Array(4 * means.length);
  means.forEach(([x, y, z], ix) => {
    words[4 * ix] = (x | (y << 13) | (z << 26)) >>> 0;
    words[4 * ix + 1] = (z >>> 6) | 0xffff_ff80; // The other bits belong to other values.
  });
  return words;
}

/** Fixed pseudorandom means. */
function randomMeans(n: number): [number, number, number][] {
  let state = 12_345;
  const next = (): number => {
    state = (Math.imul(state, 1_664_525) + 1_013_904_223) >>> 0;
    return state >>> 19;
  };
  return Array.from({ length: n }, () => [next(), next(), next()]);
}

function positionOf(mean: [number, number, number]): number[] {
  return mean.map((value, axis) => MIN_M[axis]! + (value * (MAX_M[axis]! - MIN_M[axis]!)) / MEAN_MAX);
}

test("splats are ordered from far to near, without those behind the camera", () => {
  const means = randomMeans(2 * UNIT_SPLATS + 44);
  const units = [2, 0, 5];
  const sorter = new SplatSorter();
  sorter.set({ kind: "set", units, words: wordsOf(means), minM: MIN_M, maxM: MAX_M, ...SCALES });
  const forward: [number, number, number] = [0.36, 0.48, 0.8];
  const offset = -0.4;
  const order = sorter.sort({ kind: "sort", forward, offset });

  const depths = new Map(
    means.map((mean, ix) => {
      const depth = positionOf(mean).reduce((sum, value, axis) => sum + forward[axis]! * value, offset);
      return [units[Math.floor(ix / UNIT_SPLATS)]! * UNIT_SPLATS + (ix % UNIT_SPLATS), depth];
    }),
  );
  const inFront = [...depths].filter(([, depth]) => depth > 0);
  assert.ok(inFront.length > 100 && inFront.length < means.length - 100, "the scene tests both sides");
  assert.deepEqual(new Set(order), new Set(inFront.map(([slot]) => slot)));
  assert.equal(order.length, inFront.length);
  // Positions are 32-bit floats, so that depths closer than this may be swapped.
  order.slice(1).forEach((slot, ix) => {
    const [before, depth] = [depths.get(order[ix]!)!, depths.get(slot)!];
    assert.ok(before >= depth - 1e-6, `a splat at ${before} m comes before one at ${depth} m`);
  });
});

test("equal depths keep their order", () => {
  const sorter = new SplatSorter();
  const words = wordsOf([
    [0, 0, 9],
    [1, 0, 4000],
    [2, 0, 9],
    [3, 0, 4000],
  ]);
  sorter.set({ kind: "set", units: [1], words, minM: [0, 0, 0], maxM: MAX_M, ...SCALES });
  const order = sorter.sort({ kind: "sort", forward: [0, 0, 1], offset: 0 });
  assert.deepEqual(
    [...order],
    [1, 3, 0, 2].map((ix) => UNIT_SPLATS + ix),
  );
});

test("freed units are left out, and a newer version of a chunk replaces the older one", () => {
  const sorter = new SplatSorter();
  const sorted = (): number[] => [...sorter.sort({ kind: "sort", forward: [0, 0, 1], offset: 0 })];
  const set = (units: number[], means: [number, number, number][]): void =>
    sorter.set({ kind: "set", units, words: wordsOf(means), minM: [0, 0, 0], maxM: MAX_M, ...SCALES });
  set([0], [[0, 0, 10]]);
  set(
    [3],
    [
      [0, 0, 20],
      [0, 0, 30],
    ],
  );
  assert.deepEqual(sorted(), [3 * UNIT_SPLATS + 1, 3 * UNIT_SPLATS, 0]);
  sorter.free({ kind: "free", units: [0] });
  assert.deepEqual(sorted(), [3 * UNIT_SPLATS + 1, 3 * UNIT_SPLATS]);
  set([3], [[0, 0, 40]]);
  assert.deepEqual(sorted(), [3 * UNIT_SPLATS]);
});

/** A splat at a place, with a scale code and an opacity. */
function splatWords(means: [number, number, number][], scaleCode: number, alphas: number[]): Uint32Array<ArrayBuffer> {
  const words = wordsOf(means);
  means.forEach(([, , z], ix) => {
    words[4 * ix + 1] = ((z >>> 6) | (scaleCode << 7) | (scaleCode << 15) | (scaleCode << 23)) >>> 0;
    words[4 * ix + 3] = 0xffff_ff00 | alphas[ix]!;
  });
  return words;
}

const LENS = { sizePx: [400, 400] as [number, number], focalPx: [200, 200] as [number, number], principalPx: [200, 200] as [number, number], nearM: 0.05 };
/** The identity: the model is in the frame of the camera. */
const IN_CAMERA = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];

test("splats around an eye are ordered by distance, also those behind it, and turning changes nothing", () => {
  const means = randomMeans(300);
  const sorter = new SplatSorter();
  const alphas = means.map(() => 200);
  sorter.set({ kind: "set", units: [1, 0, 2], words: splatWords(means, 0, alphas), minM: MIN_M, maxM: MAX_M, ...SCALES });
  const eye: [number, number, number] = [0.1, -0.2, 0.4];
  const around = { kind: "sort around" as const, eye, cameraFromModel: IN_CAMERA, lens: LENS, share: 1 };
  const { order } = sorter.sortAround(around);
  assert.equal(order.length, 300);
  const units = [1, 0, 2];
  const bySlot = new Map(means.map((mean, ix) => [units[Math.floor(ix / UNIT_SPLATS)]! * UNIT_SPLATS + (ix % UNIT_SPLATS), mean]));
  const distances = [...order].map((slot) => Math.hypot(...positionOf(bySlot.get(slot)!).map((value, axis) => value - eye[axis]!)));
  for (const [ix, distance] of distances.slice(1).entries()) assert.ok(distances[ix]! >= distance - 1e-6);
  const turned = [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0];
  assert.deepEqual(sorter.sortAround({ ...around, cameraFromModel: turned }).order, order);
});

test("the covered pixels grow with the square of the scale of the headset's space, and shrink with the extent", () => {
  const means: [number, number, number][] = [[4096, 4096, 7000]];
  const sorter = new SplatSorter();
  sorter.set({ kind: "set", units: [0], words: splatWords(means, 200, [255]), minM: MIN_M, maxM: MAX_M, ...SCALES });
  const around = { kind: "sort around" as const, eye: [0, 0, 0] as [number, number, number], lens: LENS, share: 1 };
  const near = sorter.sortAround({ ...around, cameraFromModel: IN_CAMERA }).coveredPx;
  // Half as large at half the distance: the same pixels.
  const half = sorter.sortAround({ ...around, cameraFromModel: IN_CAMERA.map((value) => 0.5 * value) }).coveredPx;
  for (const [ix, px] of near.entries()) assert.ok(Math.abs(px - half[ix]!) < 1e-6 * px, `${near} and ${half}`);
  assert.ok(near[0]! > near[1]! && near[1]! > near[2]! && near[2]! > near[3]! && near[3]! > 0);
});

test("a part of the splats consists of the most opaque ones", () => {
  const means = randomMeans(100);
  const sorter = new SplatSorter();
  const alphas = means.map((_, ix) => 2 * ix + 20);
  sorter.set({ kind: "set", units: [0], words: splatWords(means, 0, alphas), minM: MIN_M, maxM: MAX_M, ...SCALES });
  const { order, coveredPx } = sorter.sortAround({ kind: "sort around", eye: [0, 0, 0], cameraFromModel: IN_CAMERA, lens: LENS, share: 0.3 });
  assert.deepEqual(new Set(order), new Set(Array.from({ length: 30 }, (_, ix) => 70 + ix)));
  const all = sorter.sortAround({ kind: "sort around", eye: [0, 0, 0], cameraFromModel: IN_CAMERA, lens: LENS, share: 1 });
  assert.deepEqual(coveredPx, all.coveredPx, "the count is that of all splats");
});
