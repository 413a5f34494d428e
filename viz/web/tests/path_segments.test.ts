import assert from "node:assert/strict";
import { test } from "node:test";
import { pathSegments } from "../src/layers/path_segments";

test("the path has no segment to a point that starts a line", () => {
  assert.deepEqual(pathSegments(4, []), [0, 1, 1, 2, 2, 3]);
  assert.deepEqual(pathSegments(5, [2, 4]), [0, 1, 2, 3]);
  assert.deepEqual(pathSegments(1, []), []);
  assert.deepEqual(pathSegments(0, []), []);
});
