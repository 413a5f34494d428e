import assert from "node:assert/strict";
import { test } from "node:test";
import type { Point, Rect } from "../src/view/handle_places";
import { covers, distance, placeLabel } from "../src/view/label_places";

const VIEW: Rect = { left: 0, top: 0, right: 800, bottom: 600 };
const SIZE = { width: 260, height: 24 };

function isClear(points: [Point, Point]): void {
  const center = placeLabel(points, SIZE, VIEW, points);
  for (const point of points) assert.ok(!covers(center, SIZE, point), JSON.stringify({ points, center }));
  assert.ok(center.x >= 130 && center.x <= 670 && center.y >= 12 && center.y <= 588, JSON.stringify(center));
}

test("labels cover neither point, whatever the direction and length of the line", () => {
  for (const length of [0, 3, 40, 120, 300]) {
    for (let angle = 0; angle < 2 * Math.PI; angle += 0.2) {
      const offset = { x: 0.5 * length * Math.cos(angle), y: 0.5 * length * Math.sin(angle) };
      isClear([
        { x: 400 - offset.x, y: 300 - offset.y },
        { x: 400 + offset.x, y: 300 + offset.y },
      ]);
    }
  }
});

test("labels at an edge stay in view and off the points", () => {
  isClear([{ x: 2, y: 2 }, { x: 40, y: 6 }]);
  isClear([{ x: 790, y: 300 }, { x: 792, y: 320 }]);
  isClear([{ x: 400, y: 598 }, { x: 430, y: 596 }]);
});

test("labels are off the points of other measurements if possible", () => {
  const points: [Point, Point] = [{ x: 300, y: 300 }, { x: 500, y: 300 }];
  const alone = placeLabel(points, SIZE, VIEW, points);
  const other = { x: alone.x + 5, y: alone.y };
  const center = placeLabel(points, SIZE, VIEW, [...points, other]);
  for (const point of [...points, other]) assert.ok(!covers(center, SIZE, point));
});

test("labels are close to the middle of their lines, whatever the direction", () => {
  for (const length of [60, 120, 300]) {
    for (let angle = 0; angle < Math.PI; angle += 0.2) {
      const offset = { x: 0.5 * length * Math.cos(angle), y: 0.5 * length * Math.sin(angle) };
      const points: [Point, Point] = [{ x: 400 - offset.x, y: 300 - offset.y }, { x: 400 + offset.x, y: 300 + offset.y }];
      const away = distance(placeLabel(points, SIZE, VIEW, points), SIZE, { x: 400, y: 300 });
      assert.ok(away < 15, `${away} px at ${length} px, ${angle} rad`);
    }
  }
});
