import assert from "node:assert/strict";
import { test } from "node:test";
import type { NumberedKeyframe } from "../src/connection/protocol";
import { byTime, nearestInTime } from "../src/panels/keyframe_times";
import { stopwatchText } from "../src/panels/quantities";

function keyframe(id: number, secs: number): NumberedKeyframe {
  return { id, stamp_nanos: secs * 1e9, camera: "wrist", world_from_camera: [], size_px: [4, 3], focal_px: [1, 1], principal_px: [2, 1.5] };
}

test("keyframes are ordered by time, whatever the order of their numbers", () => {
  const list = [keyframe(3, 2), keyframe(1, 9), keyframe(2, 0.5)];
  assert.deepEqual(byTime(list).map(({ id }) => id), [2, 3, 1]);
  assert.equal(list[0]!.id, 3, "the list itself is unchanged");
});

test("the nearest keyframe is found before, between and after the others", () => {
  const ordered = [0, 10, 20].map((secs, id) => keyframe(id, secs));
  const nearest = [-5, 4, 6, 15.1, 99].map((secs) => nearestInTime(ordered, secs * 1e9));
  assert.deepEqual(nearest, [0, 0, 1, 2, 2]);
  assert.equal(nearestInTime([], 0), -1);
});

test("durations read like a stopwatch", () => {
  assert.deepEqual([0, 9.99, 130, 3599.9, 3600, 36061, -1].map(stopwatchText), ["0:00", "0:09", "2:10", "59:59", "1:00:00", "10:01:01", "0:00"]);
});
