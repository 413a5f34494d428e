import assert from "node:assert/strict";
import { test } from "node:test";
import type { NumberedKeyframe } from "../src/connection/protocol";
import { keyframeKey, nearestKeyframe, neighborKeyframe, orderedKeyframes } from "../src/panels/keyframe_order";

function keyframe(id: number, stamp_nanos: number, x = 0): NumberedKeyframe {
  const world_from_camera = [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  return { id, stamp_nanos, camera: "wrist", world_from_camera, size_px: [4, 3], focal_px: [2, 2], principal_px: [2, 1.5] };
}

const ids = (keyframes: NumberedKeyframe[]): number[] => keyframes.map(({ id }) => id);
const ALL = [keyframe(3, 30), keyframe(1, 10), keyframe(2, 20)];

test("keyframes are ordered by time or by error, the measured ones first", () => {
  const psnrOf = new Map([
    [keyframeKey(ALL[0]!), 25],
    [keyframeKey(ALL[2]!), 18],
  ]);
  assert.deepEqual(ids(orderedKeyframes(ALL, "time", psnrOf)), [1, 2, 3]);
  assert.deepEqual(ids(orderedKeyframes(ALL, "error", psnrOf)), [2, 3, 1]);
  assert.deepEqual(ids(orderedKeyframes(ALL, "error", new Map())), [1, 2, 3]);
});

test("the neighbors end at the ends, and exist for removed keyframes", () => {
  const ordered = orderedKeyframes(ALL, "time", new Map());
  const neighbor = (shown: NumberedKeyframe, step: number): number | undefined =>
    neighborKeyframe(ordered, shown, step)?.id;
  assert.deepEqual([neighbor(ALL[2]!, 1), neighbor(ALL[2]!, -1)], [3, 1]);
  assert.deepEqual([neighbor(ALL[0]!, 1), neighbor(ALL[1]!, -1)], [3, 1]);
  const removed = keyframe(9, 25);
  assert.deepEqual([neighbor(removed, 1), neighbor(removed, -1)], [3, 2]);
  assert.equal(neighborKeyframe([], removed, 1), undefined);
});

test("the nearest keyframe is close and looks in the same direction", () => {
  const behind = keyframe(4, 40, 0.1);
  behind.world_from_camera = [-1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1];
  const view = keyframe(0, 0, 0.1).world_from_camera;
  assert.equal(nearestKeyframe([keyframe(1, 1, 0.6), behind, keyframe(2, 2, 5)], view, 1)?.id, 1);
  assert.equal(nearestKeyframe([], view, 1), undefined);
});
