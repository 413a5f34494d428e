import assert from "node:assert/strict";
import { test } from "node:test";
import { Vector3 } from "three";
import { CameraPath, type PathView } from "../src/view/camera_path";
import { assertClose, fakeClock } from "./close";

/** Frames from one view to the next: 2 s at 30 Hz. */
const SEGMENT_FRAMES = 60;

function view(position: [number, number, number], target: [number, number, number], fovDegrees = 60): PathView {
  return { position: new Vector3(...position), target: new Vector3(...target), fovDegrees };
}

function pathOf(views: PathView[]): CameraPath {
  const path = new CameraPath();
  for (const each of views) path.add(each);
  return path;
}

test("the path passes through all views", () => {
  const views = [
    view([1, 0, 1], [0, 0, 0], 40),
    view([0, 2, 1], [0, 0.5, 0], 50),
    view([-3, 0, 2], [0, 0, 0.5], 70),
    view([0, -1, 1], [0.2, 0, 0], 60),
  ];
  const frames = pathOf(views).frames();
  assert.equal(frames.length, 3 * SEGMENT_FRAMES + 1);
  views.forEach((expected, ix) => {
    const frame = frames[ix * SEGMENT_FRAMES]!;
    assertClose(frame.position.toArray(), expected.position.toArray(), 1e-9);
    assertClose(frame.target.toArray(), expected.target.toArray(), 1e-9);
    assertClose([frame.fovDegrees], [expected.fovDegrees], 1e-9);
  });
});

test("between evenly spaced views on a line, the path is that line at constant speed", () => {
  const frames = pathOf([0, 1, 2, 3].map((x) => view([x, 2 * x, 1], [x, 0, 0], 50 + x))).frames();
  for (const part of [0.25, 0.5, 0.75]) {
    const frame = frames[(1 + part) * SEGMENT_FRAMES]!;
    assertClose(frame.position.toArray(), [1 + part, 2 + 2 * part, 1], 1e-9);
    assertClose([frame.fovDegrees], [51 + part], 1e-9);
  }
});

test("a view that is changed later does not change the path", () => {
  const added = view([1, 2, 3], [0, 0, 0]);
  const path = pathOf([added]);
  added.position.set(9, 9, 9);
  assertClose(path.frames()[0]!.position.toArray(), [1, 2, 3], 0);
});

test("the file has a row-major pose of an OpenGL camera for each frame", () => {
  const path = pathOf([view([2, 0, 1], [0, 0, 1], 45), view([2, 0, 2], [0, 0, 2], 45)]);
  const file = JSON.parse(path.file([800, 400]));
  assert.deepEqual([file.camera_type, file.render_width, file.render_height], ["perspective", 800, 400]);
  assert.deepEqual([file.fps, file.seconds, file.camera_path.length], [30, 2, SEGMENT_FRAMES + 1]);
  const first = file.camera_path[0];
  assert.deepEqual([first.fov, first.aspect], [45, 2]);
  // Columns: right is world y, up is world z, and the camera looks along -z, which is world -x.
  assertClose(first.camera_to_world, [0, 0, 1, 2, 1, 0, 0, 0, 0, 1, 0, 1, 0, 0, 0, 1], 1e-12);
});

test("the playback follows the clock, and ends at the last view", (context) => {
  const clock = fakeClock(context);
  const path = pathOf([view([0, 0, 0], [1, 0, 0])]);
  path.play();
  assert.ok(!path.isPlaying, "a single view cannot be played");
  path.add(view([4, 0, 0], [5, 0, 0]));
  assert.equal(path.current(), null);
  clock.millis = 500;
  path.play();
  clock.millis = 1500;
  assertClose(path.current()!.position.toArray(), [2, 0, 0], 1e-9);
  clock.millis = 2500;
  assertClose(path.current()!.position.toArray(), [4, 0, 0], 1e-9);
  assert.ok(!path.isPlaying);
  assert.equal(path.current(), null);
});

test("clearing the path ends its playback", (context) => {
  fakeClock(context);
  const path = pathOf([view([0, 0, 0], [1, 0, 0]), view([4, 0, 0], [5, 0, 0])]);
  path.play();
  path.clear();
  assert.deepEqual([path.nViews, path.isPlaying, path.current()], [0, false, null]);
});
