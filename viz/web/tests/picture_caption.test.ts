import assert from "node:assert/strict";
import { test } from "node:test";
import { drawCaption, pictureName, timeText } from "../src/view/picture_caption";

const TIME = new Date(2026, 10, 29, 11, 9, 34);

test("saved pictures are named by run, model and time, without spaces", () => {
  assert.equal(timeText(TIME), "2026-11-29 11:09:34");
  const identity = { rig: "arm", robot: null, run: "20261124-071645" };
  assert.equal(pictureName(identity, "splat", TIME), "fieldrig-20261124-071645-splat-2026-11-29-110934.png");
  assert.equal(pictureName({ ...identity, run: "a/b c" }, "", TIME), "fieldrig-a-b-c-2026-11-29-110934.png");
  assert.equal(pictureName(undefined, "", TIME), "fieldrig-2026-11-29-110934.png");
});

/** Records the texts and rectangles that are drawn, relative to the upper left corner of the picture. */
function recorder(width: number, height: number): { context: CanvasRenderingContext2D; texts: string[]; boxes: number[][] } {
  const [texts, boxes] = [[] as string[], [] as number[][]];
  let origin = [0, 0];
  const context = {
    canvas: { width, height },
    translate: (x: number, y: number) => (origin = [x, y]),
    fillText: (text: string) => texts.push(text),
    fillRect: (x: number, y: number, w: number, h: number) => boxes.push([origin[0]! + x, origin[1]! + y, w, h]),
    createLinearGradient: () => ({ addColorStop: () => undefined }),
  };
  return { context: context as unknown as CanvasRenderingContext2D, texts, boxes };
}

test("the caption is inside of the picture, with a legend only if there is one", () => {
  const plain = recorder(800, 600);
  drawCaption(plain.context, 2, "splat, current", null);
  assert.deepEqual(plain.texts, ["splat, current"]);
  const legend = { title: "Age", labels: ["1 s", "10 s", "100 s"], colors: ["#fff", "#000"] };
  const full = recorder(800, 600);
  drawCaption(full.context, 2, "splat, current", legend);
  for (const text of ["splat, current", "1 s", "10 s", "100 s"]) assert.ok(full.texts.includes(text), text);
  assert.ok(full.texts.some((text) => text.startsWith("Age")));
  assert.equal(full.boxes.length, 2);
  for (const [x, y, width, height] of [...plain.boxes, ...full.boxes] as [number, number, number, number][]) {
    assert.ok(x >= 0 && y >= 0 && x + width <= 800 && y + height <= 600);
  }
});
