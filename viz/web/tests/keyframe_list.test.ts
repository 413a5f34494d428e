import assert from "node:assert/strict";
import { test } from "node:test";
import { KeyframeList } from "../src/panels/keyframe_list";
import type { KeyframeChanges, NumberedKeyframe } from "../src/connection/protocol";

function keyframe(id: number, x: number): NumberedKeyframe {
  const world_from_camera = [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  return {
    id,
    stamp_nanos: id,
    camera: "wrist",
    world_from_camera,
    size_px: [4, 3],
    focal_px: [2, 2],
    principal_px: [2, 1.5],
  };
}

function changes(from_version: number, keyframes: NumberedKeyframe[], removed: number[] = []): KeyframeChanges {
  return { type: "keyframe_changes", from_version, version: from_version + 1, keyframes, removed };
}

function positions(list: KeyframeList): [number, number][] {
  return list.keyframes.map(({ id, world_from_camera }) => [id, world_from_camera[3]!]);
}

test("keyframes are added, moved and removed", () => {
  const list = new KeyframeList();
  list.apply(changes(0, [keyframe(1, 0.1), keyframe(2, 0.2), keyframe(3, 0.3)]));
  list.apply(changes(1, [keyframe(2, 0.25), keyframe(4, 0.4)], [1, 99]));
  assert.deepEqual(positions(list), [
    [2, 0.25],
    [3, 0.3],
    [4, 0.4],
  ]);
});

test("a message from version 0 replaces the list", () => {
  const list = new KeyframeList();
  list.apply(changes(0, [keyframe(1, 0.1), keyframe(2, 0.2)]));
  list.apply(changes(0, [keyframe(5, 0.5)]));
  assert.deepEqual(positions(list), [[5, 0.5]]);
});
