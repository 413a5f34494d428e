import assert from "node:assert/strict";
import { test } from "node:test";
import css from "../src/app.css" with { type: "text" };

type Rgb = [number, number, number];

/** WCAG 2.2, success criteria 1.4.3 and 1.4.11. */
const MIN_TEXT = 4.5;
const MIN_STATE = 3;
const WHITE: Rgb = [255, 255, 255];

/** Value of a CSS variable: red, green, blue and opacity. */
function variable(name: string): [Rgb, number] {
  const digits = new RegExp(`--${name}: #([0-9a-f]{6})([0-9a-f]{2})?;`).exec(css);
  if (!digits) throw new Error(`app.css has no color --${name}`);
  const channel = (at: number): number => Number.parseInt(digits[1]!.slice(at, at + 2), 16);
  return [[channel(0), channel(2), channel(4)], digits[2] ? Number.parseInt(digits[2], 16) / 255 : 1];
}

/** A background over a white picture, which is the worst case for light text. */
function onWhite(name: string): Rgb {
  const [color, opacity] = variable(name);
  return color.map((value, ix) => value * opacity + WHITE[ix]! * (1 - opacity)) as Rgb;
}

/** Relative luminance as in WCAG 2.2. */
function luminance(rgb: Rgb): number {
  const [r, g, b] = rgb.map((value) => {
    const share = value / 255;
    return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
  }) as Rgb;
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
}

function contrast(a: Rgb, b: Rgb): number {
  const [dark, light] = [luminance(a), luminance(b)].sort((x, y) => x - y) as [number, number];
  return (light + 0.05) / (dark + 0.05);
}

function assertContrast(foreground: string, background: string, min: number): void {
  const found = contrast(variable(foreground)[0], onWhite(background));
  assert.ok(found >= min, `--${foreground} on --${background}: ${found.toFixed(2)}, expected ${min}`);
}

test("the contrast is that of the standard", () => {
  assert.equal(contrast(WHITE, [0, 0, 0]).toFixed(2), "21.00");
  assert.equal(contrast([0x77, 0x77, 0x77], WHITE).toFixed(2), "4.48");
  assert.throws(() => assertContrast("line", "panel", MIN_STATE));
});

test("texts are legible, also over white pictures and on disabled buttons", () => {
  for (const background of ["ground", "panel", "raised", "overlay"]) {
    for (const text of ["text", "soft", "dim", "off", "accent", "warn"]) assertContrast(text, background, MIN_TEXT);
  }
  assertContrast("on-accent", "accent", MIN_TEXT);
});

test("edges of controls, states and the ring of the focus are visible", () => {
  for (const background of ["ground", "panel", "raised", "overlay"]) {
    for (const mark of ["edge", "accent", "bad"]) assertContrast(mark, background, MIN_STATE);
  }
});

test("the page uses the colors that were checked", () => {
  assert.doesNotMatch(css, /^\s*button[^{]*\{[^}]*opacity/m);
});
