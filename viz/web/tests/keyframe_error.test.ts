import assert from "node:assert/strict";
import { test } from "node:test";
import { type Comparable, compareKeyframe, type KeyframeErrors, type Pixels } from "../src/panels/keyframe_error";
import { assertClose } from "./close";

const SIZE = [320, 240] as const;
const ALL: Comparable = { mask: null, surface: null };
type Brightness = (x: number, y: number) => number;

/** A picture whose brightness, 0 to 255, is a function of the position. */
function picture(brightness: Brightness): Pixels {
  const [width, height] = SIZE;
  const data = new Uint8ClampedArray(4 * width * height).fill(255);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) data.fill(brightness(x, y), 4 * (y * width + x), 4 * (y * width + x) + 3);
  }
  return { width, height, data };
}

/** Waves in all directions, coarse and fine. */
function scene(x: number, y: number): number {
  return 110 + 40 * Math.sin(x / 11 + y / 23) + 30 * Math.cos(y / 9 - x / 31) + 12 * Math.sin(x * 1.9) * Math.cos(y * 1.7);
}

function blurred(x: number, y: number): number {
  let sum = 0;
  for (let dy = -2; dy <= 2; dy++) for (let dx = -2; dx <= 2; dx++) sum += scene(x + dx, y + dy);
  return sum / 25;
}

/** An sRGB code at another exposure. */
function exposed(code: number, factor: number): number {
  const linear = code / 255 <= 0.04045 ? code / 255 / 12.92 : ((code / 255 + 0.055) / 1.055) ** 2.4;
  const bright = factor * linear;
  return 255 * (bright <= 0.0031308 ? 12.92 * bright : 1.055 * bright ** (1 / 2.4) - 0.055);
}

function compared(photo: Brightness, render: Brightness, comparable = ALL): KeyframeErrors {
  const errors = compareKeyframe(picture(photo), picture(render), comparable);
  assert.ok(errors);
  return errors;
}

test("equal pictures have no fault", () => {
  const errors = compared(scene, scene);
  assert.equal(errors.psnr, Infinity);
  assert.deepEqual([errors.worst, errors.shiftPx, errors.emptyFrac], [null, null, null]);
  assertClose([errors.exposureEv!, errors.detailRatio!], [0, 1], 1e-6);
  assert.ok(errors.map.every((error) => error === 0));
});

test("the exposure is measured, and does not count as another fault", () => {
  const errors = compared((x, y) => exposed(scene(x, y), 2 ** 0.4), scene);
  assertClose([errors.exposureEv!], [0.4], 0.03);
  assert.deepEqual([errors.worst, errors.shiftPx], [null, null]);
  assertClose([errors.detailRatio!], [1], 0.15);
  assert.ok(errors.psnr < 25, `${errors.psnr}`);
  assertClose([compared(scene, (x, y) => exposed(scene(x, y), 2 ** 0.4)).exposureEv!], [-0.4], 0.03);
});

test("a moved object is named by its place", () => {
  const at = (left: number, top: number) => (x: number, y: number) =>
    x >= left && x < left + 60 && y >= top && y < top + 50 ? 250 : scene(x, y);
  for (const [left, top, name] of [
    [10, 10, "upper left"],
    [250, 180, "lower right"],
    [130, 95, "middle"],
    [130, 5, "upper middle"],
    [5, 95, "left middle"],
  ] as const) {
    assert.equal(compared(at(left, top), scene).worst?.name, name);
  }
});

test("a blurred photograph differs from a blurred model", () => {
  assert.ok(compared(blurred, scene).detailRatio! < 0.5);
  assert.ok(compared(scene, blurred).detailRatio! > 2);
  assert.equal(compared(() => 90, () => 91).detailRatio, null, "without texture, nothing can be said");
});

test("a shift is measured in pixels of the photograph", () => {
  const errors = compared((x, y) => scene(x - 4, y + 2), scene);
  assert.ok(errors.shiftPx);
  assertClose(errors.shiftPx, [4, -2], 0.6);
  // Noise and blur are no shift.
  assert.equal(compared(blurred, scene).shiftPx, null);
});

test("masked pixels do not count, and missing surfaces are counted", () => {
  const [width, height] = SIZE;
  const isLeft = Uint8Array.from({ length: width * height }, (_, ix) => (ix % width < width / 2 ? 0 : 255));
  const wrongLeft = (x: number, y: number): number => (x < width / 2 ? 0 : scene(x, y));
  const masked = compared(wrongLeft, scene, { mask: isLeft, surface: null });
  assert.equal(masked.psnr, Infinity);
  assert.equal(masked.map[0], -1);
  assert.equal(masked.map[width - 1], 0);
  const empty = compared(scene, wrongLeft, { mask: null, surface: isLeft });
  assertClose([empty.emptyFrac!], [0.5], 1e-9);
  assert.equal(empty.worst, null, "what the model does not have is no moved object");
});

test("pictures that cannot be compared lead to nothing", () => {
  const whole = picture(scene);
  assert.equal(compareKeyframe(whole, { width: 2, height: 2, data: new Uint8Array(16) }, ALL), null);
  const none = new Uint8Array(SIZE[0] * SIZE[1]);
  assert.equal(compareKeyframe(whole, whole, { mask: none, surface: null }), null);
});
