import assert from "node:assert/strict";
import { test } from "node:test";
import { Box3, Matrix4, PerspectiveCamera, Vector3 } from "three";
import type { Viewpoint } from "../src/view/eye_guard";
import {
  boundsOf,
  cornersOf,
  frontDirection,
  headingOfBase,
  headingOfCamera,
  overviewDirection,
  topDirection,
  viewOf,
} from "../src/view/overview";
import { type Heading, OverviewKeeper } from "../src/view/overview_keeper";
import type { Scene } from "../src/connection/protocol";
import type { RobotLayer } from "../src/layers/robot_layer";
import type { ScanLayer } from "../src/layers/scan_layer";
import { SceneViews } from "../src/view/scene_views";
import { assertClose } from "./close";

const UP = new Vector3(0, 0, 1);
const LENSES = [
  { fovDegrees: 50, aspect: 1.6, up: UP },
  { fovDegrees: 50, aspect: 0.5, up: UP },
  { fovDegrees: 90, aspect: 1, up: UP },
];
const AHEAD: Heading = { rad: 0, isRobot: true };

function box(min: [number, number, number], max: [number, number, number]): Box3 {
  return new Box3(new Vector3(...min), new Vector3(...max));
}

/** Where points are in the picture, -1 to 1 from left to right and from bottom to top. */
function inPicture(points: Vector3[], { eye, target }: Viewpoint, lens: (typeof LENSES)[0]): Vector3[] {
  const camera = new PerspectiveCamera(lens.fovDegrees, lens.aspect, 0.01, 100);
  camera.up.copy(lens.up);
  camera.position.copy(eye);
  camera.lookAt(target);
  camera.updateMatrixWorld();
  return points.map((point) => point.clone().project(camera));
}

test("a view of everything contains all points, and is as close as possible", () => {
  const corners = cornersOf([box([-1, -2, 0], [4, 1, 1.5]), box([6, 0, 0], [6.5, 0.5, 1])]);
  for (const lens of LENSES) {
    for (const direction of [overviewDirection(0.7, true), overviewDirection(-2, false), topDirection(), frontDirection(1)]) {
      const view = viewOf(corners, direction, lens);
      const reach = inPicture(corners, view, lens).map(({ x, y }) => Math.max(Math.abs(x), Math.abs(y)));
      // Toolbars cover the border of the picture.
      assertClose([Math.max(...reach)], [0.86], 1e-6);
      assertClose(view.target.clone().sub(view.eye).normalize().toArray(), direction.clone().normalize().toArray(), 1e-9);
    }
  }
});

test("a world with another direction of up is seen from above, too", () => {
  const lens = { ...LENSES[0]!, up: new Vector3(0, -1, 0) };
  const corners = cornersOf([box([-1, -2, 0], [4, 1, 1.5])]);
  const view = viewOf(corners, overviewDirection(0, false), lens);
  assert.ok(view.eye.dot(lens.up) > view.target.dot(lens.up) + 1);
  for (const { x, y } of inPicture(corners, view, lens)) assert.ok(Math.abs(x) < 0.87 && Math.abs(y) < 0.87);
});

test("a single point is seen from a small distance", () => {
  const view = viewOf([new Vector3(1, 2, 3)], overviewDirection(0, true), LENSES[0]!);
  assert.ok(view.eye.distanceTo(new Vector3(1, 2, 3)) > 0.04);
});

test("the overview is seen from behind and above the robot, the front view against its heading", () => {
  for (const rad of [0, 1.2, -2.5]) {
    const base = new Matrix4().makeRotationZ(rad);
    assertClose([headingOfBase(base)], [rad], 1e-9);
    const front = new Vector3(Math.cos(rad), Math.sin(rad), 0);
    assert.ok(overviewDirection(rad, true).dot(front) > 0.5);
    assert.ok(overviewDirection(rad, true).z < -0.4);
    assertClose(frontDirection(rad).toArray(), front.negate().toArray(), 1e-9);
  }
  assertClose(frontDirection(null).toArray(), [0, 1, 0], 0);
});

test("the heading of a camera is where it looks or, if it looks down, where the upper edge of its image is", () => {
  // Columns: x right, y down, z forward.
  const along = [0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1]; // looks along x
  assertClose([headingOfCamera(along)], [0], 1e-9);
  const down = [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]; // looks down, the upper edge is at +y
  assertClose([headingOfCamera(down)], [Math.PI / 2], 1e-9);
});

test("older servers send only a center and a radius", () => {
  const scene = { type: "scene" as const, center_m: [1, 2, 3] as [number, number, number], radius_m: 2, world_from_camera: [] };
  const bounds = boundsOf(scene);
  assertClose(bounds.getCenter(new Vector3()).toArray(), [1, 2, 3], 1e-12);
  assertClose(bounds.getSize(new Vector3()).toArray(), [3, 3, 3], 1e-12);
  const newer = boundsOf({ ...scene, bounds: { min_m: [0, 0, 0], max_m: [1, 1, 2] } });
  assertClose([...newer.min.toArray(), ...newer.max.toArray()], [0, 0, 0, 1, 1, 2], 0);
});

test("the overview follows growth, but neither small changes nor a robot that turns", () => {
  const keeper = new OverviewKeeper();
  const lens = LENSES[0]!;
  const scene = box([0, 0, 0], [2, 2, 1]);
  assert.equal(keeper.update([new Box3()], AHEAD, lens), null, "nothing is known");
  const first = keeper.update([scene], { rad: 1, isRobot: false }, lens);
  assert.ok(first);
  assert.equal(keeper.update([scene], { rad: 2, isRobot: false }, lens), null);
  const robot = box([1, 1, 0], [1.5, 1.5, 1]);
  const withRobot = keeper.update([scene, robot], AHEAD, lens);
  assert.ok(withRobot, "the robot gives the direction");
  assert.ok(withRobot.eye.x < 0, "from behind");
  assert.equal(keeper.update([scene, robot], { rad: 2, isRobot: true }, lens), null, "it turns");
  assert.equal(keeper.update([scene, box([1, 1, 0], [2.05, 1.5, 1])], AHEAD, lens), null, "it moves a little");
  const away = box([6, 1, 0], [6.5, 1.5, 1]);
  const grown = keeper.update([scene, away], { rad: 2, isRobot: true }, lens);
  assert.ok(grown, "it leaves the picture");
  assertClose(
    grown.target.clone().sub(grown.eye).normalize().toArray(),
    withRobot.target.clone().sub(withRobot.eye).normalize().toArray(),
    1e-9,
  );
  for (const { x, y } of inPicture(cornersOf([scene, away]), grown, lens)) {
    assert.ok(Math.abs(x) < 0.87 && Math.abs(y) < 0.87);
  }
  assert.equal(keeper.update([scene, robot], AHEAD, lens), null, "it comes back");
  keeper.refit();
  assert.ok(keeper.update([scene, robot], AHEAD, lens), "the window has another shape");
});

test("an overview that is asked for is there at once, also shortly after the last check", () => {
  const robot = { isVisible: false, namedLinks: null } as unknown as RobotLayer;
  const views = new SceneViews(new PerspectiveCamera(50, 0.5), robot, { pathBox: new Box3() } as ScanLayer);
  views.scene = { center_m: [0, 0, 0], radius_m: 1, world_from_camera: [1, 0, 0, 0, 0, 0, 1, -2, 0, -1, 0, 0, 0, 0, 0, 1] } as Scene;
  const first = views.overview();
  assert.ok(first);
  assert.equal(views.overview(), null, "it shows everything");
  assert.ok(views.along("top"));
  views.restartOverview();
  assert.deepEqual(views.overview(), first);
});
