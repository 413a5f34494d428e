// Decodes the depth format `compact_half`; the encoder is viz/src/pictures/compact_depth.rs.

import { inflated } from "./zlib";

/** Symbol of a pixel whose count follows after the symbols. */
const ESCAPE = 255;
/** The server renders at most 4096 x 4096 pixels. */
const MAX_PIXELS = 4096 * 4096;
/** A symbol and an escaped count. */
const MAX_BYTES_PER_PIXEL = 3;

/** Depths in meters, 0 without a surface. */
export async function decodeCompactDepth(
  zlib: Uint8Array<ArrayBuffer>,
  [width, height]: [number, number],
  minM: number,
  logStep: number,
): Promise<Float32Array<ArrayBuffer>> {
  const n = width * height;
  if (!(n <= MAX_PIXELS)) throw new Error(`a depth image has ${width} x ${height} pixels, more than ${MAX_PIXELS}`);
  const bytes = await inflated(zlib, MAX_BYTES_PER_PIXEL * n);
  if (bytes.length < n) throw new Error(`a depth image has ${bytes.length} symbols, not ${n}`);
  const codes = new Uint16Array(n);
  let escaped = n;
  let largest = 0;
  for (let ix = 0, y = 0; y < height; y++) {
    for (let x = 0; x < width; x++, ix++) {
      const symbol = bytes[ix]!;
      let code: number;
      if (symbol === ESCAPE) {
        code = bytes[escaped]! | (bytes[escaped + 1]! << 8);
        escaped += 2;
      } else {
        // 0, -1, 1, -2, 2, ...
        const difference = symbol & 1 ? -((symbol + 1) >> 1) : symbol >> 1;
        // A count is predicted by the count to its left or, in the first column, by the count above
        // it.
        code = (codes[x > 0 ? ix - 1 : ix - width] ?? 0) + difference;
      }
      codes[ix] = code;
      if (code > largest) largest = code;
    }
  }
  if (escaped !== bytes.length) throw new Error(`a depth image has ${bytes.length} bytes, not ${escaped}`);
  const meters = new Float32Array(largest + 1);
  for (let code = 1; code <= largest; code++) meters[code] = minM * Math.exp(logStep * (code - 1));
  const depth = new Float32Array(n);
  for (let ix = 0; ix < n; ix++) depth[ix] = meters[codes[ix]!]!;
  return depth;
}
