import assert from "node:assert/strict";
import { test } from "node:test";
import { type Anchor, type HandlePlace, placeHandles, type Rect } from "../src/view/handle_places";

const VIEW: Rect = { left: 0, top: 0, right: 800, bottom: 600 };
const TOOLBAR: Rect = { left: 300, top: 10, right: 790, bottom: 50 };

function at(x: number, y: number, isBehind = false): Anchor {
  return { x, y, isBehind };
}

function isIn({ x, y }: HandlePlace, { left, top, right, bottom }: Rect): boolean {
  return x >= left && x <= right && y >= top && y <= bottom;
}

test("handles in view stay where they are", () => {
  const anchors = [at(400, 300), at(405, 302), at(10, 10)];
  assert.deepEqual(
    placeHandles(anchors, VIEW, [TOOLBAR]),
    anchors.map(({ x, y }) => ({ x, y, isMoved: false })),
  );
});

test("handles outside the view or under a toolbar are moved to where they can be reached", () => {
  const anchors = [at(-200, 300), at(900, 700), at(500, 30), at(400, -50), at(400, 300)];
  const places = placeHandles(anchors, VIEW, [TOOLBAR]);
  assert.deepEqual(places.map(({ isMoved }) => isMoved), [true, true, true, true, false]);
  for (const place of places) assert.ok(isIn(place, VIEW) && !isIn(place, TOOLBAR), JSON.stringify(place));
  assert.ok(Math.abs(places[0]!.y - 300) < 1 && places[0]!.x < 30, "the nearest place");
});

test("moved handles are apart from each other", () => {
  // The viewer is inside the box: all sides are out of view, some of them behind.
  const anchors = [at(-1e5, 300), at(1e5, 300), at(400, 1e5), at(400, -1e5), at(400, 1e5, true), at(401, 900, true)];
  const places = placeHandles(anchors, VIEW, [TOOLBAR]);
  places.forEach((place, ix) => {
    assert.ok(isIn(place, VIEW) && !isIn(place, TOOLBAR), JSON.stringify(place));
    for (const other of places.slice(0, ix)) assert.ok(Math.hypot(place.x - other.x, place.y - other.y) > 30);
  });
});

test("handles straight behind the viewer have a place", () => {
  const [place] = placeHandles([at(400, 300, true)], VIEW, []);
  assert.ok(isIn(place!, VIEW) && place!.isMoved);
});

test("a view without any free place keeps the handles in view", () => {
  const [place] = placeHandles([at(900, 300)], VIEW, [VIEW]);
  assert.ok(isIn(place!, VIEW));
});
