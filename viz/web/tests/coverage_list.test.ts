import assert from "node:assert/strict";
import { test } from "node:test";
import type { PhotographCoverage } from "../src/connection/protocol";
import { cellRectangle, coverageEntries } from "../src/panels/coverage_list";

const parts = Array.from({ length: 9 }, (_, ix) => ({ is_covered: ix < 4, is_next: ix === 5 }));
const COVERAGE: PhotographCoverage = {
  camera: "front",
  size_px: [640, 480],
  cells: [16, 9],
  is_covered: Array.from({ length: 144 }, () => false),
  parts,
  items: [
    { label: "left side away", n_done: 3, n_needed: 2, is_next: false },
    { label: "near", n_done: 1, n_needed: 2, is_next: true },
    { label: "far", n_done: 0, n_needed: 2, is_next: false },
  ],
};

test("each entry is done, next or missing", () => {
  assert.deepEqual(coverageEntries(COVERAGE), [
    { text: "left side away 2/2", state: "done" },
    { text: "near 1/2", state: "next" },
    { text: "far 0/2", state: "missing" },
    { text: "parts of the image 4/9", state: "next" },
  ]);
  const covered = { ...COVERAGE, parts: parts.map(() => ({ is_covered: true, is_next: false })) };
  assert.deepEqual(coverageEntries(covered).at(-1), { text: "parts of the image 9/9", state: "done" });
});

test("cells fill the image row by row", () => {
  assert.deepEqual(cellRectangle(0, [16, 9], [640, 480]), { x: 0, y: 0, width: 40, height: 480 / 9 });
  const last = cellRectangle(143, [16, 9], [640, 480]);
  assert.deepEqual([last.x + last.width, Math.round(last.y + last.height)], [640, 480]);
  assert.deepEqual(cellRectangle(5, [3, 3], [300, 150]), { x: 200, y: 50, width: 100, height: 50 });
});
