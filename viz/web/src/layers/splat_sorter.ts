// Sorts splats by depth, or by distance from an eye. It runs in a worker, because sorting takes longer than a frame.

import { type FillLens, FillSum, meanShadow, reachOf } from "./splat_fill";

/** Splats per unit of memory, see splat_layer.ts. */
export const UNIT_SPLATS = 128;

/** The units that hold a chunk, and its splats: four words each. */
export interface SetChunk {
  kind: "set";
  units: number[];
  words: Uint32Array<ArrayBuffer>;
  minM: [number, number, number];
  maxM: [number, number, number];
  /** Lowest logarithm of a standard deviation, and the step of its counts. */
  minLogScale: number;
  logScaleStep: number;
}

/** Units that no longer hold splats. */
export interface FreeUnits {
  kind: "free";
  units: number[];
}

/** Requests the order of the splats in front of a camera: `depth = offset + dot(forward, position)`. */
export interface Sort {
  kind: "sort";
  forward: [number, number, number];
  offset: number;
}

/**
 * Requests the order of the splats around an eye. It stays valid while the eye only turns, and serves both eyes of a headset
 * (as `sortRadial` of Spark does).
 */
export interface SortAround {
  kind: "sort around";
  /** Position of the eye in the frame of the model. */
  eye: [number, number, number];
  /** Maps points of the model to the frame of the camera: three rows of four numbers. */
  cameraFromModel: number[];
  /** The lens for which the covered pixels are counted. */
  lens: FillLens;
  /** Fraction of the splats to draw: the most opaque ones. */
  share: number;
}

/** Slots of the splats in front of the camera or around the eye, the most distant first. */
export interface SortResult {
  order: Uint32Array<ArrayBuffer>;
  /** Pixels that all splats cover, for each of the extents; only after `sort around`. */
  coveredPx?: number[];
}

const MEAN_MAX = 8191;
const N_ALPHAS = 256;

/** Positions of the splats by slot: `UNIT_SPLATS * unit + index`. */
export class SplatSorter {
  private positions = new Float32Array(0);
  /** Mean shadow of each splat, square units of the model. */
  private shadows = new Float32Array(0);
  private alphas = new Uint8Array(0);
  /** Number of splats in each unit. */
  private readonly counts: number[] = [];

  set({ units, words, minM, maxM, minLogScale, logScaleStep }: SetChunk): void {
    const n = words.length / 4;
    const step = maxM.map((max, axis) => (max - minM[axis]!) / MEAN_MAX);
    this.reserve(Math.max(...units) + 1);
    const scales = Float64Array.from({ length: 256 }, (_, code) => Math.exp(minLogScale + code * logScaleStep));
    for (let ix = 0; ix < n; ix++) {
      const slot = units[Math.floor(ix / UNIT_SPLATS)]! * UNIT_SPLATS + (ix % UNIT_SPLATS);
      const [low, high] = [words[4 * ix]!, words[4 * ix + 1]!];
      this.positions[3 * slot] = minM[0] + (low & 8191) * step[0]!;
      this.positions[3 * slot + 1] = minM[1] + ((low >>> 13) & 8191) * step[1]!;
      this.positions[3 * slot + 2] = minM[2] + ((low >>> 26) | ((high & 127) << 6)) * step[2]!;
      const ofAxis = (shift: number): number => scales[(high >>> shift) & 255]!;
      this.shadows[slot] = meanShadow([ofAxis(7), ofAxis(15), ofAxis(23)]);
      this.alphas[slot] = words[4 * ix + 3]! & 255;
    }
    units.forEach((unit, ix) => {
      this.counts[unit] = Math.min(UNIT_SPLATS, n - ix * UNIT_SPLATS);
    });
  }

  free({ units }: FreeUnits): void {
    for (const unit of units) this.counts[unit] = 0;
  }

  /** Sorts the splats in front of a camera by their depths. */
  sort({ forward, offset }: Sort): Uint32Array<ArrayBuffer> {
    const { positions } = this;
    const depths = new Float32Array(this.nSplats);
    const slots = new Uint32Array(depths.length);
    let n = 0;
    this.counts.forEach((count, unit) => {
      for (let slot = unit * UNIT_SPLATS; slot < unit * UNIT_SPLATS + count; slot++) {
        const at = 3 * slot;
        const depth =
          offset + forward[0] * positions[at]! + forward[1] * positions[at + 1]! + forward[2] * positions[at + 2]!;
        if (depth <= 0) continue;
        depths[n] = depth;
        slots[n] = slot;
        n += 1;
      }
    });
    return descending(n, depths, slots);
  }

  /** Sorts by the distance from an eye, and counts the pixels that the splats cover. */
  sortAround({ eye, cameraFromModel: rows, lens, share }: SortAround): Required<SortResult> {
    const { positions, alphas, shadows } = this;
    const squares = new Float32Array(this.nSplats);
    const slots = new Uint32Array(squares.length);
    const fill = new FillSum(lens);
    // The frame of the camera may be smaller than that of the model, if a headset shows the scene on a table.
    const scale2 = rows[0]! ** 2 + rows[1]! ** 2 + rows[2]! ** 2;
    const minAlpha = share < 1 ? this.alphaOfShare(share) : 0;
    let n = 0;
    this.counts.forEach((count, unit) => {
      for (let slot = unit * UNIT_SPLATS; slot < unit * UNIT_SPLATS + count; slot++) {
        const [x, y, z] = [positions[3 * slot]!, positions[3 * slot + 1]!, positions[3 * slot + 2]!];
        const along = (row: number): number =>
          rows[4 * row]! * x + rows[4 * row + 1]! * y + rows[4 * row + 2]! * z + rows[4 * row + 3]!;
        fill.add(along(0), along(1), along(2), shadows[slot]! * scale2, reachOf(alphas[slot]!));
        if (alphas[slot]! < minAlpha) continue;
        squares[n] = (x - eye[0]) ** 2 + (y - eye[1]) ** 2 + (z - eye[2]) ** 2;
        slots[n] = slot;
        n += 1;
      }
    });
    return { order: descending(n, squares, slots), coveredPx: fill.coveredPx };
  }

  private get nSplats(): number {
    return this.counts.reduce((sum, count) => sum + (count ?? 0), 0);
  }

  /** The lowest opacity, 0 to 255, of the most opaque splats that are this fraction of all splats or a little more. */
  private alphaOfShare(share: number): number {
    const numbers = new Uint32Array(N_ALPHAS);
    this.counts.forEach((count, unit) => {
      for (let slot = unit * UNIT_SPLATS; slot < unit * UNIT_SPLATS + count; slot++) numbers[this.alphas[slot]!]! += 1;
    });
    const nWanted = share * this.nSplats;
    let [alpha, n] = [N_ALPHAS, 0];
    while (alpha > 0 && n < nWanted) n += numbers[--alpha]!;
    return alpha;
  }

  private reserve(nUnits: number): void {
    const nValues = UNIT_SPLATS * nUnits;
    if (this.alphas.length >= nValues) return;
    this.positions = grown(this.positions, new Float32Array(6 * nValues));
    this.shadows = grown(this.shadows, new Float32Array(2 * nValues));
    this.alphas = grown(this.alphas, new Uint8Array(2 * nValues));
  }
}

function grown<T extends Float32Array | Uint8Array>(from: T, to: T): T {
  to.set(from);
  return to;
}

/** The first `n` slots by their non-negative keys, the largest first. Sorts exactly, with two passes of a radix sort. */
function descending(n: number, values: Float32Array<ArrayBuffer>, slots: Uint32Array): Uint32Array<ArrayBuffer> {
  const keys = new Uint32Array(values.buffer);
  // Positive floats sort like their bits. The bits are inverted, so that the most distant splats come first.
  for (let ix = 0; ix < n; ix++) keys[ix] = ~keys[ix]!;
  const [keysLow, slotsLow] = [new Uint32Array(n), new Uint32Array(n)];
  scatter(n, keys, slots, 0, keysLow, slotsLow);
  const order = new Uint32Array(n);
  scatter(n, keysLow, slotsLow, 16, keys, order);
  return order;
}

/** Sorts by 16 bits of the keys. Equal keys keep their order. */
function scatter(
  n: number,
  keys: Uint32Array,
  slots: Uint32Array,
  shift: number,
  sortedKeys: Uint32Array,
  sortedSlots: Uint32Array,
): void {
  const begins = new Uint32Array(65_537);
  for (let ix = 0; ix < n; ix++) begins[((keys[ix]! >>> shift) & 65_535) + 1]! += 1;
  for (let ix = 1; ix < begins.length; ix++) begins[ix]! += begins[ix - 1]!;
  for (let ix = 0; ix < n; ix++) {
    const to = begins[(keys[ix]! >>> shift) & 65_535]!++;
    sortedKeys[to] = keys[ix]!;
    sortedSlots[to] = slots[ix]!;
  }
}
