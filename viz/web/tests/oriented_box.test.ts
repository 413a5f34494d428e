import assert from "node:assert/strict";
import { test } from "node:test";
import { Vector3, Vector4 } from "three";
import { boxFromWorld, type Crop, OrientedBox } from "../src/view/oriented_box";
import { assertClose } from "./close";

const RIGHT_ANGLE = Math.PI / 2;

function boxOf(center: [number, number, number], size: [number, number, number], yaw: number): OrientedBox {
  const box = new OrientedBox();
  box.set(new Vector3(...center), new Vector3(...size), yaw);
  return box;
}

/** Whether the box of a request contains a point in world. */
function contains(crop: Crop, point: [number, number, number]): boolean {
  const rows = boxFromWorld(crop);
  return rows.every((row, axis) => {
    const along = row.dot(new Vector4(...point, 1));
    return along >= crop.min_m[axis]! && along <= crop.max_m[axis]!;
  });
}

test("a box without rotation is sent along the axes of the world", () => {
  const { request } = boxOf([1, 2, 3], [2, 4, 6], 0);
  assert.deepEqual(request, { min_m: [0, 0, 0], max_m: [2, 4, 6] });
});

test("a rotated box contains the same points in its frame as in world", () => {
  const { request } = boxOf([1, 2, 3], [4, 0.2, 2], RIGHT_ANGLE);
  assertClose(request.world_from_box!, [0, -1, 0, 1, 1, 0, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1], 1e-12);
  // Its long side lies along y of the world.
  assert.ok(contains(request, [1, 3.9, 3]) && contains(request, [1.09, 2, 3.9]));
  assert.ok(!contains(request, [1, 4.1, 3]) && !contains(request, [1.2, 2, 3]) && !contains(request, [1, 2, 4.1]));
});

test("moving a side keeps the opposite one", () => {
  for (const yaw of [0, 0.7]) {
    const box = boxOf([1, 2, 3], [2, 2, 2], yaw);
    const opposite = box.sideCenter({ axis: 0, isMax: false });
    const before = box.sideCenter({ axis: 0, isMax: true });
    box.moveSide({ axis: 0, isMax: true }, 0.5, 0.1);
    assertClose(box.sideCenter({ axis: 0, isMax: false }).toArray(), opposite.toArray(), 1e-12);
    const moved = box.sideCenter({ axis: 0, isMax: true }).sub(before);
    assertClose(moved.toArray(), box.direction(0).multiplyScalar(0.5).toArray(), 1e-12);
  }
});

test("sides keep a minimum length", () => {
  for (const yaw of [0, 0.7]) {
    const box = boxOf([0, 0, 0], [2, 2, 2], yaw);
    box.moveSide({ axis: 1, isMax: false }, -5, 0.1);
    assertClose(box.size.toArray(), [2, 0.1, 2], 1e-12);
    assertClose(box.sideCenter({ axis: 1, isMax: true }).toArray(), box.direction(1).toArray(), 1e-12);
  }
});

test("the edge for rotating is at the largest x and y of the box", () => {
  assertClose(boxOf([1, 1, 1], [2, 4, 6], 0).edgeCenter.toArray(), [2, 3, 1], 1e-12);
  assertClose(boxOf([1, 1, 1], [2, 4, 6], RIGHT_ANGLE).edgeCenter.toArray(), [-1, 2, 1], 1e-12);
});
