import assert from "node:assert/strict";
import { test } from "node:test";
import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { Axis, Scene } from "../src/connection/protocol";
import { boundsOf, cornersOf, overviewDirection, viewOf } from "../src/view/overview";
import { AXES, turnControls, upCommand, upInWorld, uprightRotation } from "../src/view/up_axis";
import { assertClose } from "./close";

const TOLERANCE = 1e-9;
const SCENE: Scene = { type: "scene", center_m: [1, -2, 0.5], radius_m: 0.8, world_from_camera: [] };

test("the axis that the server shows upright is up, whichever it is", () => {
  for (const axis of AXES) assertClose(upInWorld(axis, axis).toArray(), [0, 0, 1], TOLERANCE);
});

test("other axes of the model are found in the world of the page", () => {
  const cases: [Axis, Axis, number[]][] = [
    ["z", "-y", [0, -1, 0]],
    ["z", "x", [1, 0, 0]],
    // `--up -y` rotates the model by a quarter turn about x.
    ["-y", "z", [0, 1, 0]],
    ["-y", "x", [1, 0, 0]],
    ["-y", "y", [0, 0, -1]],
    // `--up -z` rotates it by half a turn about x.
    ["-z", "x", [1, 0, 0]],
    ["-z", "y", [0, -1, 0]],
  ];
  for (const [served, axis, expected] of cases) assertClose(upInWorld(served, axis).toArray(), expected, TOLERANCE);
});

test("orbiting turns about the new direction of up", () => {
  for (const axis of AXES) {
    const up = upInWorld("z", axis);
    const camera = new THREE.PerspectiveCamera(50, 1.5, 0.01, 100);
    camera.up.set(0, 0, 1);
    const controls = new OrbitControls(camera);
    turnControls(controls, up);
    const corners = cornersOf([boundsOf(SCENE)]);
    const { eye, target } = viewOf(corners, overviewDirection(0, false), { fovDegrees: 50, aspect: 1.5, up });
    camera.position.copy(eye);
    controls.target.copy(target);
    controls.update();
    const heightBefore = camera.position.clone().sub(target).dot(up);
    const right = new THREE.Vector3(1, 0, 0).applyQuaternion(camera.quaternion);
    assert.ok(Math.abs(right.dot(up)) < TOLERANCE, `${axis}: the view is level`);
    assert.ok(heightBefore > 0, `${axis}: seen from above`);
    controls.autoRotate = true;
    controls.autoRotateSpeed = 100;
    controls.update(0.5);
    const moved = camera.position.distanceTo(eye);
    assert.ok(moved > 0.1, `${axis}: moved by ${moved}`);
    const height = camera.position.clone().sub(target).dot(up);
    assertClose([height], [heightBefore], 1e-6);
  }
});

test("upright rotations map z to up", () => {
  for (const axis of AXES) {
    const up = upInWorld("z", axis);
    const rotated = new THREE.Vector3(0, 0, 1).applyQuaternion(uprightRotation(up));
    assertClose(rotated.toArray(), up.toArray(), TOLERANCE);
  }
});

test("paths in commands are quoted for a shell", () => {
  assert.equal(upCommand("scans/guitar.compressed.ply", "-y"), "fieldrig view scans/guitar.compressed.ply --up -y");
  assert.equal(upCommand("my scan's.ply", "x"), "fieldrig view 'my scan'\\''s.ply' --up x");
});
