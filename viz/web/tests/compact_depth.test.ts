import assert from "node:assert/strict";
import { test } from "node:test";
import { deflateSync } from "node:zlib";
import { decodeCompactDepth } from "../src/layers/compact_depth";
import { decodeDepth } from "../src/layers/depth_part";
import { assertClose } from "./close";

const MIN_M = 0.5;
const LOG_STEP = 0.004;
/** Rounding of depths to 32-bit floats. */
const FLOAT_ERROR_M = 1e-6;

/** Codes of the image below, 0 without a surface. */
const CODES = [0, 5, 4, 0, 300, 301, 299, 301];
/** 4 x 2 pixels: differences to the pixel on the left are 0, -1, 1, -2, 2, ...; 255 is followed by a code at the end. */
const SYMBOLS = [0, 255, 1, 255, 255, 2, 3, 4];
const ESCAPED = [5, 0, 0, 0, 300 & 255, 300 >> 8];

function compressed(bytes: number[]): Uint8Array<ArrayBuffer> {
  return Uint8Array.from(deflateSync(Uint8Array.from(bytes)));
}

function metersOf(code: number): number {
  return code === 0 ? 0 : MIN_M * Math.exp(LOG_STEP * (code - 1));
}

test("symbols and escaped codes are decoded", async () => {
  const depth = await decodeCompactDepth(compressed([...SYMBOLS, ...ESCAPED]), [4, 2], MIN_M, LOG_STEP);
  assertClose(depth, CODES.map(metersOf), FLOAT_ERROR_M);
});

test("the first pixel of a row is predicted from the row above", async () => {
  // Codes 7 and 8, then 7 + 2 = 9 and 9 - 1 = 8.
  const depth = await decodeCompactDepth(compressed([255, 2, 4, 1, 7, 0]), [2, 2], MIN_M, LOG_STEP);
  assertClose(depth, [7, 8, 9, 8].map(metersOf), FLOAT_ERROR_M);
});

test("streams that are too short, too long or corrupt are rejected", async () => {
  const decode = (bytes: number[], size: [number, number] = [4, 2]): Promise<Float32Array> =>
    decodeCompactDepth(compressed(bytes), size, MIN_M, LOG_STEP);
  await assert.rejects(decode(SYMBOLS.slice(1)), /has 7 symbols, not 8/);
  await assert.rejects(decode([...SYMBOLS, ...ESCAPED.slice(2)]), /has 12 bytes, not 14/);
  await assert.rejects(decode([...SYMBOLS, ...ESCAPED, 1, 1]), /has 16 bytes, not 14/);
  await assert.rejects(decode(new Array<number>(25).fill(0)), /longer than 24 bytes/);
  await assert.rejects(decode(SYMBOLS, [4097, 4096]), /more than 16777216/);
  await assert.rejects(decode(SYMBOLS, [Number.NaN, 1]));
  await assert.rejects(decodeCompactDepth(Uint8Array.of(1, 2, 3), [4, 2], MIN_M, LOG_STEP));
});

test("depth is found at any offset of the payload, in each format", async () => {
  const stream = compressed([...SYMBOLS, ...ESCAPED]);
  const counts = [0x10, 0x27, 0x00, 0x00]; // 10,000 and 0.
  const floats = [...new Uint8Array(Float32Array.of(1.25, 0).buffer)];
  const payload = Uint8Array.from([1, ...counts, ...floats, ...stream, 2]);
  const u16 = await decodeDepth(
    { format: "u16_half", meters_per_count: 2e-4, size_px: [2, 1], offset: 1, bytes: 4 },
    payload,
  );
  assertClose(u16.depth, [2, 0], FLOAT_ERROR_M);
  const f32 = await decodeDepth({ format: "f32", meters_per_count: 2, size_px: [2, 1], offset: 5, bytes: 8 }, payload);
  assertClose(f32.depth, [2.5, 0], FLOAT_ERROR_M);
  const compact = await decodeDepth(
    { format: "compact_half", min_m: MIN_M, log_step: LOG_STEP, size_px: [4, 2], offset: 13, bytes: stream.length },
    payload,
  );
  assertClose(compact.depth, CODES.map(metersOf), FLOAT_ERROR_M);
  assert.deepEqual(
    [u16.sizePx, f32.sizePx, compact.sizePx],
    [
      [2, 1],
      [2, 1],
      [4, 2],
    ],
  );
});
