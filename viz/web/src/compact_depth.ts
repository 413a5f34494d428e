// Decodes the depth format `compact_half`; the encoder is viz/src/compact_depth.rs.

/** Symbol of a pixel whose count follows after the symbols. */
const ESCAPE = 255;

/** Depths in meters, 0 without a surface. */
export async function decodeCompactDepth(
  zlib: Uint8Array<ArrayBuffer>,
  [width, height]: [number, number],
  minM: number,
  logStep: number,
): Promise<Float32Array<ArrayBuffer>> {
  const stream = new Blob([zlib]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const n = width * height;
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
        // The count to the left predicts a count; in the first column, the count above.
        code = (codes[x > 0 ? ix - 1 : ix - width] ?? 0) + difference;
      }
      codes[ix] = code;
      if (code > largest) largest = code;
    }
  }
  const meters = new Float32Array(largest + 1);
  for (let code = 1; code <= largest; code++) meters[code] = minM * Math.exp(logStep * (code - 1));
  const depth = new Float32Array(n);
  for (let ix = 0; ix < n; ix++) depth[ix] = meters[codes[ix]!]!;
  return depth;
}
