import assert from "node:assert/strict";
import { test } from "node:test";
import { Box3, BoxGeometry, Mesh, type Material, PerspectiveCamera, Vector3 } from "three";
import { blockOf, blockText, canBeCut } from "../src/view/block";
import { Cut } from "../src/view/cut";
import { hiddenDistanceM } from "../src/view/hidden_robot";
import { LinkLook, nearOpacity } from "../src/layers/link_look";
import type { Occlusion } from "../src/layers/occlusion";
import { arrowPlace } from "../src/view/robot_arrow";
import { assertClose } from "./close";

const FORWARD = new Vector3(0, 1, 0);

test("a blocked motion names the side of the wall", () => {
  const text = (x: number, y: number): string => blockText(blockOf(new Vector3(x, y, 0), FORWARD, true));
  assert.equal(text(0.1, -1), "A wall is behind you");
  assert.equal(text(0.1, 2), "A surface is in front of you");
  assert.equal(text(1, 0.1), "A wall is beside you");
  assert.match(blockText(blockOf(new Vector3(0, -1, 0), FORWARD, false)), /behind you is hidden/);
  assert.ok(canBeCut(blockOf(FORWARD, FORWARD, false)));
  assert.ok(!canBeCut({ by: "far end" }) && !canBeCut({ by: "near end" }));
});

test("a cut leaves the surroundings of the target while the eye moves away", () => {
  const cut = new Cut();
  assert.equal(cut.depthM(3, 0.01), 0.01);
  // A wall has stopped the eye 1 m from its target.
  cut.begin(1, 10, true);
  assert.ok(cut.isOn);
  assertClose([cut.depthM(1, 0.01), cut.depthM(3, 0.01)], [0.2, 2.2], 1e-9);
  assertClose([cut.depthM(0.5, 0.01)], [0.01], 0);
  // From outside, a scene with a radius of 2 m.
  cut.begin(6, 2, false);
  assertClose([cut.depthM(6, 0.01)], [5], 1e-9);
  cut.end();
  assert.equal(cut.depthM(6, 0.01), 0.01);
});

/** A camera at the origin that looks along y, and is twice as wide as high. */
function camera(): PerspectiveCamera {
  const camera = new PerspectiveCamera(50, 2, 0.01, 100);
  camera.up.set(0, 0, 1);
  camera.lookAt(FORWARD);
  camera.updateMatrixWorld();
  return camera;
}

function boxAt(x: number, y: number, z: number): Box3 {
  return new Box3().setFromCenterAndSize(new Vector3(x, y, z), new Vector3(0.5, 0.5, 0.5));
}

test("an arrow at the border points to a robot outside of the picture", () => {
  const place = (box: Box3) => arrowPlace(box, camera(), [800, 400]);
  assert.equal(place(new Box3()), null, "no robot");
  assert.equal(place(boxAt(0, 3, 0)), null, "visible");
  assert.equal(place(boxAt(3.9, 4, 0)), null, "partly visible");
  const right = place(boxAt(10, 3, 0))!;
  assertClose([right.x, right.y, right.angleRad], [766, 200, 0], 1e-6);
  const left = place(boxAt(-10, -3, 0))!;
  assertClose([left.x, left.y, Math.abs(left.angleRad)], [34, 200, Math.PI], 1e-6);
  const above = place(boxAt(0, 3, 10))!;
  assertClose([above.x, above.y, above.angleRad], [400, 96, -Math.PI / 2], 1e-6);
  const behind = place(boxAt(0, -5, 0))!;
  assertClose([behind.x, behind.y, behind.angleRad], [400, 316, Math.PI / 2], 1e-6);
  assert.equal(place(boxAt(0, -0.3, 0)), null, "the eye is on the robot");
});

test("the model hides the robot only if it hides all of it", () => {
  const robot = boxAt(0, 4, 0);
  const eye = new Vector3();
  const wallAt = (y: number, maxX: number) => (point: Vector3) =>
    point.x <= maxX ? point.clone().multiplyScalar(y / point.y) : null;
  const distance = hiddenDistanceM(robot, eye, wallAt(2, 1));
  // Up to the closest corner.
  assertClose([distance ?? NaN], [4 - 0.25 * Math.sqrt(3)], 1e-9);
  assert.equal(hiddenDistanceM(robot, eye, wallAt(2, 0.1)), null, "one side is visible");
  assert.equal(hiddenDistanceM(robot, eye, wallAt(4.1, 1)), null, "the wall is behind it");
  assert.equal(hiddenDistanceM(robot, eye, () => null), null);
  assert.equal(hiddenDistanceM(new Box3(), eye, wallAt(2, 1)), null);
  const cut = new Cut();
  cut.beginAt(3.5, 3);
  assertClose([cut.depthM(3, 0.01), cut.depthM(4, 0.01)], [3.5, 4.5], 1e-9);
});

test("a link fades close to the eye, and disappears around it", () => {
  assert.equal(nearOpacity(0.31), 1);
  assert.equal(nearOpacity(0.05), 0);
  const look = new LinkLook({ apply: (material: unknown) => material } as unknown as Occlusion);
  const material = look.material([1, 0, 0, 1]);
  const mesh = new Mesh(new BoxGeometry(200, 200, 200), material as Material);
  mesh.scale.setScalar(0.001); // The file is in millimeters.
  mesh.updateMatrixWorld();
  const depthOnly = look.add(mesh).material as Material;
  const opacityAt = (x: number): number => {
    look.fadeNear(new Vector3(x, 0, 0));
    assert.equal(material.transparent, material.opacity < 1);
    return material.visible ? material.opacity : 0;
  };
  assert.equal(opacityAt(0.45), 1);
  const halfway = opacityAt(0.1 + 0.19);
  assert.ok(halfway > 0.4 && halfway < 0.6, `${halfway}`);
  assert.equal(opacityAt(0.05), 0, "inside");
  look.outdated = true;
  assert.equal(depthOnly.visible, false, "what lies behind a fading link is visible");
  assertClose([opacityAt(0.45)], [0.35], 1e-9);
  assert.equal(depthOnly.visible, true);
});
