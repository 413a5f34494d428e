import assert from "node:assert/strict";
import { test } from "node:test";
import { Matrix4 } from "three";
import type { EyeLens } from "../src/headset/eye_lens";
import { withMargin } from "../src/headset/server_pictures";
import { HANDHELD_LIMITS, RefreshRule, SPHERE_LIMITS } from "../src/headset/refresh_rule";
import {
  ARM_LENGTH_M,
  buttonAt,
  cut,
  layOut,
  type MenuButton,
  MIN_X_HEIGHT_DEGREES,
  wrapped,
  xHeightDegrees,
} from "../src/headset/menu_layout";

test("the picture for an eye has the pixels of the eye, and a margin of whole pixels", () => {
  const lens = { sizePx: [320, 300], focalPx: [160, 170], principalPx: [170.25, 148.5] } as const;
  const copy = { sizePx: [...lens.sizePx], focalPx: [...lens.focalPx], principalPx: [...lens.principalPx] };
  const { size_px, projection } = withMargin(copy as EyeLens);
  assert.deepEqual(size_px, [320 + 2 * 38, 300 + 2 * 36]);
  assert.deepEqual(projection, { kind: "pinhole", focal_px: [160, 170], principal_px: [170.25 + 38, 148.5 + 36] });
  const large = withMargin({ sizePx: [2000, 2000], focalPx: [1000, 1000], principalPx: [1000, 1000] });
  assert.ok(Math.max(...large.size_px) <= 1024 && Math.max(...large.size_px) > 1000);
});

const button = (id: string, span = 1): MenuButton => ({ id, label: id, span });

test("the letters are large enough at arm's length", () => {
  assert.ok(xHeightDegrees(ARM_LENGTH_M) >= MIN_X_HEIGHT_DEGREES, `${xHeightDegrees(ARM_LENGTH_M)}`);
});

test("buttons fill rows, wide ones have rows of their own, and nothing overlaps or leaves the menu", () => {
  const groups = [
    { title: "", buttons: [button("stop", 3), button("a"), button("b"), button("c"), button("d"), button("wide", 3)] },
    { title: "Second", buttons: [button("e")] },
    { title: "Empty", buttons: [] },
  ];
  const layout = layOut({ lines: ["one", "two"], groups });
  const rects = layout.buttons.map(({ rect }) => rect);
  for (const [ix, a] of rects.entries()) {
    assert.ok(a.x >= 0 && a.y >= 0 && a.x + a.width <= layout.width + 1e-12 && a.y + a.height <= layout.height);
    for (const b of rects.slice(ix + 1)) {
      const isApart = a.x + a.width <= b.x || b.x + b.width <= a.x || a.y + a.height <= b.y || b.y + b.height <= a.y;
      assert.ok(isApart, JSON.stringify([a, b]));
    }
  }
  assert.deepEqual(layout.lines.map(({ text }) => text), ["one", "two", "Second"]);
  for (const { button: expected, rect } of layout.buttons) {
    assert.equal(buttonAt(layout, rect.x + 0.5 * rect.width, rect.y + 0.5 * rect.height), expected);
  }
  assert.equal(buttonAt(layout, 0.001, 0.001), null);
});

test("texts are cut with an ellipsis and wrapped at words", () => {
  const widthOf = (text: string): number => text.length;
  assert.equal(cut("short", 10, widthOf), "short");
  assert.equal(cut("rather long", 8, widthOf), "rather…");
  assert.deepEqual(wrapped("one two three forest", 9, 3, widthOf), ["one two", "three", "forest"]);
  assert.deepEqual(wrapped("one two three forest", 10, 2, widthOf), ["one two", "three for…"]);
  assert.deepEqual(wrapped("", 9, 2, widthOf), []);
});

test("a picture in the hand is renewed after 0.1 m or 1 degree, and a sphere only after 0.5 m", () => {
  const pose = (meters: number, degrees: number): Matrix4 =>
    new Matrix4().makeRotationY((degrees * Math.PI) / 180).setPosition(meters, 0, 0);
  const hand = new RefreshRule(HANDHELD_LIMITS);
  assert.ok(hand.isDue(pose(0, 0), 0, false), "the first");
  assert.ok(!hand.isDue(pose(0.09, 0), 10, false));
  assert.ok(hand.isDue(pose(0.11, 0), 20, false));
  assert.ok(!hand.isDue(pose(0.11, 0.9), 30, false));
  assert.ok(hand.isDue(pose(0.11, 1.1), 40, false));
  assert.ok(!hand.isDue(pose(0.11, 1.1), 5000, false), "at rest");
  assert.ok(hand.isDue(pose(0.11, 1.1), 5001, true), "while the model trains");
  const sphere = new RefreshRule(SPHERE_LIMITS);
  assert.ok(sphere.isDue(pose(0, 0), 0, false));
  assert.ok(!sphere.isDue(pose(0.45, 170), 10, false));
  assert.ok(sphere.isDue(pose(0.55, 170), 20, false));
  sphere.forget();
  assert.ok(sphere.isDue(pose(0.55, 170), 30, false));
});
