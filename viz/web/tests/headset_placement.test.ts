import assert from "node:assert/strict";
import { test } from "node:test";
import { Matrix4, Quaternion, Vector3 } from "three";
import {
  atFullSize,
  grabbed,
  grabbedByTwo,
  headYawRad,
  moved,
  onFloor,
  onTable,
  type Placement,
  teleported,
  turned,
  uprightPoint,
  worldFromHeadset,
} from "../src/headset/placement";
import { SceneGrab } from "../src/headset/scene_grab";
import { StickMotion } from "../src/headset/stick_motion";

/** Rounding of f64 in a few products. */
const EPS = 1e-9;

const START: Placement = { origin: new Vector3(1, -2, 0.3), yawRad: 0.7, scale: 2.5 };

function near(actual: Vector3, expected: Vector3, what = ""): void {
  assert.ok(actual.distanceTo(expected) < EPS, `${what} ${actual.toArray()} instead of ${expected.toArray()}`);
}

function head(x: number, y: number, z: number, yawRad: number, pitchRad = 0): Matrix4 {
  return new Matrix4()
    .makeRotationY(yawRad)
    .multiply(new Matrix4().makeRotationX(pitchRad))
    .setPosition(x, y, z);
}

test("up in the headset is up in the world, forward is the y axis, and lengths are scaled", () => {
  const placement = { origin: new Vector3(), yawRad: 0, scale: 2 };
  near(uprightPoint(placement, new Vector3(0, 1, 0)), new Vector3(0, 0, 2));
  near(uprightPoint(placement, new Vector3(0, 0, -1)), new Vector3(0, 2, 0));
  near(uprightPoint(placement, new Vector3(1, 0, 0)), new Vector3(2, 0, 0));
});

test("a scene whose up is another axis stands upright", () => {
  const worldFromUpright = new Quaternion().setFromUnitVectors(new Vector3(0, 0, 1), new Vector3(0, 1, 0));
  const matrix = worldFromHeadset({ origin: new Vector3(), yawRad: 0.4, scale: 1 }, worldFromUpright);
  near(new Vector3(0, 1, 0).applyMatrix4(matrix), new Vector3(0, 1, 0));
});

test("what one hand holds stays in it", () => {
  const [before, now] = [new Vector3(0.2, 1.1, -0.4), new Vector3(-0.3, 1.4, -0.1)];
  const after = grabbed(START, before, now);
  near(uprightPoint(after, now), uprightPoint(START, before));
  assert.equal(after.scale, START.scale);
  assert.equal(after.yawRad, START.yawRad);
});

test("what two hands hold on a level line stays in both, and turns and scales with them", () => {
  const before: [Vector3, Vector3] = [new Vector3(-0.2, 1.1, -0.4), new Vector3(0.2, 1.1, -0.4)];
  const now: [Vector3, Vector3] = [new Vector3(-0.1, 1.3, -0.6), new Vector3(0.5, 1.3, -0.1)];
  const after = grabbedByTwo(START, before, now);
  for (const ix of [0, 1] as const) near(uprightPoint(after, now[ix]), uprightPoint(START, before[ix]), `hand ${ix}`);
  assert.ok(Math.abs(after.scale * now[0].distanceTo(now[1]) - START.scale * before[0].distanceTo(before[1])) < EPS);
  // The floor stays level.
  near(new Vector3(0, 1, 0).transformDirection(worldFromHeadset(after, new Quaternion())), new Vector3(0, 0, 1));
});

test("hands above each other do not turn the scene", () => {
  const before: [Vector3, Vector3] = [new Vector3(0.01, 1.0, -0.4), new Vector3(0, 1.4, -0.4)];
  const now: [Vector3, Vector3] = [new Vector3(0, 1.0, -0.41), new Vector3(0, 1.3, -0.4)];
  assert.equal(grabbedByTwo(START, before, now).yawRad, START.yawRad);
});

test("the hand that joins or lets go moves nothing", () => {
  const grab = new SceneGrab();
  const hold = (x: number, isHolding = true) => ({ position: new Vector3(x, 1, -0.5), isHolding });
  assert.equal(grab.update(START, null, hold(0)), START);
  const moving = grab.update(START, null, hold(0.1));
  assert.notEqual(moving, START);
  assert.equal(grab.update(moving, hold(-0.5), hold(0.3)), moving, "the second hand joins");
  assert.notEqual(grab.update(moving, hold(-0.5), hold(0.4)), moving);
  assert.equal(grab.update(moving, hold(-0.6, false), hold(0.5)), moving, "it lets go");
  assert.ok(grab.isHolding);
  grab.release();
  assert.ok(!grab.isHolding);
  assert.equal(grab.update(moving, null, hold(2)), moving, "a release needs no motion");
});

test("a turn keeps the head where it is", () => {
  const at = new Vector3(0.4, 1.6, -0.2);
  const after = turned(START, Math.PI / 6, at);
  near(uprightPoint(after, at), uprightPoint(START, at));
  assert.ok(Math.abs(after.yawRad - START.yawRad - Math.PI / 6) < EPS);
});

test("a jump puts the feet on the place, below the head", () => {
  const at = new Vector3(0.4, 1.6, -0.2);
  const after = teleported(START, new Vector3(3, 4, 0.5), at);
  near(uprightPoint(after, new Vector3(0.4, 0, -0.2)), new Vector3(3, 4, 0.5));
});

test("the scene on a table is 0.8 m wide, in front of the head and below it", () => {
  const scene = { center: new Vector3(2, 3, 1), radiusM: 1.6, floorM: 0.2 };
  const placement = onTable(scene, head(0.5, 1.7, 0.3, 0.9, -0.5), 0.2);
  assert.equal(placement.scale, 4);
  const inHeadset = new Vector3(2, 3, 0.2).applyMatrix4(worldFromHeadset(placement, new Quaternion()).invert());
  assert.ok(Math.abs(inHeadset.y - 1.1) < EPS, "at hand height");
  const away = inHeadset.sub(new Vector3(0.5, 0, 0.3));
  assert.ok(Math.abs(Math.atan2(-away.x, -away.z) - 0.9) < EPS, "where the head looks");
  // The direction in which the page looked is where the head looks.
  const forward = new Vector3(-Math.sin(0.9), 0, -Math.cos(0.9)).transformDirection(worldFromHeadset(placement, new Quaternion()));
  near(forward, new Vector3(-Math.sin(0.2), Math.cos(0.2), 0));
});

test("a seated operator has a table that is not on the floor", () => {
  const scene = { center: new Vector3(), radiusM: 0.4, floorM: 0 };
  const placement = onTable(scene, head(0, 0.9, 0, 0), 0);
  assert.ok(Math.abs(-placement.origin.z / placement.scale - 0.5) < EPS);
});

test("in full size, the head is above the place and looks along", () => {
  const placement = atFullSize(new Vector3(5, 6, 9), -1.1, -0.75, head(0.3, 1.6, 0.8, 2.0));
  assert.equal(placement.scale, 1);
  near(uprightPoint(placement, new Vector3(0.3, 1.6, 0.8)), new Vector3(5, 6, 0.85));
});

test("a head that looks straight down or up faces where its top or its chin points", () => {
  assert.ok(Math.abs(headYawRad(head(0, 0, 0, 0.8, -Math.PI / 2)) - 0.8) < 1e-6);
  assert.ok(Math.abs(headYawRad(head(0, 0, 0, 0.8, Math.PI / 2)) - 0.8) < 1e-6);
});

test("a ray meets the floor in front of the hand, and nothing above the horizon or too far away", () => {
  const placement = { origin: new Vector3(), yawRad: 0, scale: 1 };
  const from = new Vector3(0, 1, 0);
  near(onFloor(placement, from, new Vector3(0, -1, -1).normalize(), 0, 12)!, new Vector3(0, 1, 0));
  assert.equal(onFloor(placement, from, new Vector3(0, 0.1, -1), 0, 12), null);
  assert.equal(onFloor(placement, from, new Vector3(0, -0.01, -1), 0, 12), null);
});

test("moving by a length of the room moves by that length times the scale", () => {
  near(moved({ origin: new Vector3(), yawRad: 0, scale: 3 }, new Vector3(0, 0, -1)).origin, new Vector3(0, 3, 0));
});

test("the stick turns once per deflection, glides, and jumps when it returns", () => {
  const sticks = new StickMotion();
  const at = head(0, 1.6, 0, 0);
  const still: [number, number] = [0, 0];
  const first = sticks.update(START, still, [1, 0], at, 0.02);
  assert.ok(Math.abs(first.placement.yawRad - (START.yawRad - Math.PI / 6)) < EPS, "to the right");
  assert.equal(sticks.update(first.placement, still, [0.9, 0], at, 0.02).placement, first.placement, "held");
  sticks.update(START, still, [0.1, 0], at, 0.02);
  assert.notEqual(sticks.update(START, still, [-1, 0], at, 0.02).placement, START, "again");

  const glide = sticks.update(START, [0, 1], still, at, 0.05);
  assert.ok(glide.isMoving);
  assert.ok(Math.abs(glide.placement.origin.distanceTo(START.origin) - 1.4 * 0.05 * START.scale) < EPS);
  assert.ok(!sticks.update(START, [0.1, -0.1], still, at, 0.05).isMoving, "the dead zone");
  const long = sticks.update(START, [0, 1], still, at, 5);
  assert.ok(long.placement.origin.distanceTo(START.origin) < 0.15 * START.scale, "a pause is no leap");

  assert.ok(sticks.update(START, still, [0, 1], at, 0.02).isAiming);
  const held = sticks.update(START, still, [0.5, 0.6], at, 0.02);
  assert.ok(held.isAiming && !held.jumps);
  const end = sticks.update(START, still, still, at, 0.02);
  assert.ok(end.jumps && !end.isAiming);
  assert.ok(!sticks.update(START, still, still, at, 0.02).jumps);
});
