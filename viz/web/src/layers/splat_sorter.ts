// Sorts splats by depth. It runs in a worker, because sorting takes longer than a frame.

/** Splats per unit of memory, see splat_layer.ts. */
export const UNIT_SPLATS = 128;

/** The units that hold a chunk, and its splats: four words each. */
export interface SetChunk {
  kind: "set";
  units: number[];
  words: Uint32Array<ArrayBuffer>;
  minM: [number, number, number];
  maxM: [number, number, number];
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

/** Slots of the splats in front of the camera, the most distant first. */
export interface SortResult {
  order: Uint32Array<ArrayBuffer>;
}

const MEAN_MAX = 8191;

/** Positions of the splats by slot: `UNIT_SPLATS * unit + index`. */
export class SplatSorter {
  private positions = new Float32Array(0);
  /** Number of splats in each unit. */
  private readonly counts: number[] = [];

  set({ units, words, minM, maxM }: SetChunk): void {
    const n = words.length / 4;
    const step = maxM.map((max, axis) => (max - minM[axis]!) / MEAN_MAX);
    this.reserve(Math.max(...units) + 1);
    for (let ix = 0; ix < n; ix++) {
      const slot = units[Math.floor(ix / UNIT_SPLATS)]! * UNIT_SPLATS + (ix % UNIT_SPLATS);
      const [low, high] = [words[4 * ix]!, words[4 * ix + 1]!];
      this.positions[3 * slot] = minM[0] + (low & 8191) * step[0]!;
      this.positions[3 * slot + 1] = minM[1] + ((low >>> 13) & 8191) * step[1]!;
      this.positions[3 * slot + 2] = minM[2] + ((low >>> 26) | ((high & 127) << 6)) * step[2]!;
    }
    units.forEach((unit, ix) => {
      this.counts[unit] = Math.min(UNIT_SPLATS, n - ix * UNIT_SPLATS);
    });
  }

  free({ units }: FreeUnits): void {
    for (const unit of units) this.counts[unit] = 0;
  }

  /** Sorts exactly, with two passes of a radix sort over the bits of the depths. */
  sort({ forward, offset }: Sort): Uint32Array<ArrayBuffer> {
    const { positions } = this;
    const nAll = this.counts.reduce((sum, count) => sum + (count ?? 0), 0);
    const depths = new Float32Array(nAll);
    const keys = new Uint32Array(depths.buffer);
    const slots = new Uint32Array(nAll);
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
    // Positive floats sort like their bits. The bits are inverted, so that the most distant splats
    // come first.
    for (let ix = 0; ix < n; ix++) keys[ix] = ~keys[ix]!;
    const [keysLow, slotsLow] = [new Uint32Array(n), new Uint32Array(n)];
    scatter(n, keys, slots, 0, keysLow, slotsLow);
    const order = new Uint32Array(n);
    scatter(n, keysLow, slotsLow, 16, keys, order);
    return order;
  }

  private reserve(nUnits: number): void {
    const nValues = 3 * UNIT_SPLATS * nUnits;
    if (this.positions.length >= nValues) return;
    const larger = new Float32Array(2 * nValues);
    larger.set(this.positions);
    this.positions = larger;
  }
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
