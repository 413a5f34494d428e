import assert from "node:assert/strict";
import { test } from "node:test";
import { SplatSorter, UNIT_SPLATS } from "../src/layers/splat_sorter";

const MIN_M: [number, number, number] = [-1, -2, -3];
const MAX_M: [number, number, number] = [1, 2, 5];
const MEAN_MAX = 8191;

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
  sorter.set({ kind: "set", units, words: wordsOf(means), minM: MIN_M, maxM: MAX_M });
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
  sorter.set({ kind: "set", units: [1], words, minM: [0, 0, 0], maxM: MAX_M });
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
    sorter.set({ kind: "set", units, words: wordsOf(means), minM: [0, 0, 0], maxM: MAX_M });
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
