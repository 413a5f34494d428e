// Where the scene is around the operator: the map from the space of the headset to the world, and how hands, sticks and
// buttons change it. The space of the headset is x right, y up, z backward, in meters, with its floor at y = 0. This file has
// no DOM.

import { MathUtils, Matrix4, Quaternion, Vector3 } from "three";

/** Limits of the scale: a hall on a table, and a gripper as large as a room. */
const MIN_SCALE = 0.02;
const MAX_SCALE = 200;
/** Two hands that are closer together than this on the floor plan do not turn the scene, meters. */
const MIN_SPAN_M = 0.05;
/** Width of the scene on a table, and its distance from the head, meters. */
const TABLE_WIDTH_M = 0.8;
const TABLE_DISTANCE_M = 0.65;
/** The table is below the head by this, but not lower than a low table, meters. */
const TABLE_BELOW_HEAD_M = 0.6;
const MIN_TABLE_M = 0.5;

/** Maps the space of the headset to coordinates that are x, y on the floor of the world, and z up. */
const UPRIGHT_FROM_HEADSET = new Matrix4().makeRotationX(Math.PI / 2);

/** A map that keeps the floor level: scaled, rotated about the vertical, then moved. */
export interface Placement {
  /** Where the origin of the headset's space is in the upright world, meters. */
  origin: Vector3;
  /** Rotation about the vertical, radians. */
  yawRad: number;
  /** Meters of the world per meter of the headset's space. */
  scale: number;
}

/** The parts of the scene that matter to placements, in the upright world, meters. */
export interface SceneExtent {
  center: Vector3;
  radiusM: number;
  /** Height of the lowest part. */
  floorM: number;
}

/** The matrix that maps the space of the headset to the world. `worldFromUpright` maps the z axis to the direction of up. */
export function worldFromHeadset({ origin, yawRad, scale }: Placement, worldFromUpright: Quaternion): Matrix4 {
  const turned = new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), yawRad);
  const matrix = new Matrix4().compose(origin, turned, new Vector3(scale, scale, scale)).multiply(UPRIGHT_FROM_HEADSET);
  return matrix.premultiply(new Matrix4().makeRotationFromQuaternion(worldFromUpright));
}

/** A point of the headset's space in the upright world. */
export function uprightPoint(placement: Placement, inHeadset: Vector3): Vector3 {
  return inHeadset.clone().applyMatrix4(worldFromHeadset(placement, new Quaternion()));
}

/** Direction in which the head looks on the floor of the headset's space, as a rotation about its vertical. */
export function headYawRad(headsetFromHead: Matrix4): number {
  const forward = new Vector3(0, 0, -1).transformDirection(headsetFromHead);
  const up = new Vector3(0, 1, 0).transformDirection(headsetFromHead);
  // A head that looks straight down faces where its top points, and one that looks up the opposite.
  const flat = Math.hypot(forward.x, forward.z) > 1e-3 ? forward : up.multiplyScalar(-Math.sign(forward.y));
  return Math.atan2(-flat.x, -flat.z);
}

/** The scene on a table in front of the head, as seen from the present direction of the page's camera. */
export function onTable(scene: SceneExtent, headsetFromHead: Matrix4, viewYawRad: number): Placement {
  const head = new Vector3().setFromMatrixPosition(headsetFromHead);
  const headYaw = headYawRad(headsetFromHead);
  const tableM = Math.max(MIN_TABLE_M, head.y - TABLE_BELOW_HEAD_M);
  const inFront = new Vector3(0, 0, -TABLE_DISTANCE_M).applyAxisAngle(new Vector3(0, 1, 0), headYaw);
  const onTable = new Vector3(head.x + inFront.x, tableM, head.z + inFront.z);
  const place = new Vector3(scene.center.x, scene.center.y, scene.floorM);
  const scale = MathUtils.clamp((2 * scene.radiusM) / TABLE_WIDTH_M, MIN_SCALE, MAX_SCALE);
  return fixedAt({ origin: new Vector3(), yawRad: viewYawRad - headYaw, scale }, onTable, place);
}

/** The scene in its own size, with the head above a place, looking in a direction. `floorM`: height of the floor. */
export function atFullSize(place: Vector3, viewYawRad: number, floorM: number, headsetFromHead: Matrix4): Placement {
  const head = new Vector3().setFromMatrixPosition(headsetFromHead);
  const below = new Vector3(head.x, 0, head.z);
  const yawRad = viewYawRad - headYawRad(headsetFromHead);
  return fixedAt({ origin: new Vector3(), yawRad, scale: 1 }, below, new Vector3(place.x, place.y, floorM));
}

/** Moves the scene such that a point of the headset's space is at a point of the upright world. */
export function fixedAt(placement: Placement, inHeadset: Vector3, inUpright: Vector3): Placement {
  const offset = uprightPoint({ ...placement, origin: new Vector3() }, inHeadset);
  return { ...placement, origin: inUpright.clone().sub(offset) };
}

/** One hand that holds the scene moves it. */
export function grabbed(placement: Placement, before: Vector3, now: Vector3): Placement {
  return fixedAt(placement, now, uprightPoint(placement, before));
}

/** Two hands move, turn and scale the scene: the points that they hold stay in them. */
export function grabbedByTwo(
  placement: Placement,
  before: readonly [Vector3, Vector3],
  now: readonly [Vector3, Vector3],
): Placement {
  const [spanBefore, spanNow] = [before[0].distanceTo(before[1]), now[0].distanceTo(now[1])];
  if (spanBefore < MIN_SPAN_M || spanNow < MIN_SPAN_M) return grabbed(placement, middle(before), middle(now));
  const turn = directionRad(before) - directionRad(now);
  const isFlat = flatSpan(before) > MIN_SPAN_M && flatSpan(now) > MIN_SPAN_M;
  const changed: Placement = {
    origin: placement.origin,
    yawRad: placement.yawRad + (isFlat ? turn : 0),
    scale: MathUtils.clamp((placement.scale * spanBefore) / spanNow, MIN_SCALE, MAX_SCALE),
  };
  return fixedAt(changed, middle(now), uprightPoint(placement, middle(before)));
}

/** Turns the operator around the vertical through the head; positive turns to the left. */
export function turned(placement: Placement, byRad: number, head: Vector3): Placement {
  const place = uprightPoint(placement, head);
  return fixedAt({ ...placement, yawRad: placement.yawRad + byRad }, head, place);
}

/** Moves the operator by a distance in the headset's space. */
export function moved(placement: Placement, byInHeadset: Vector3): Placement {
  return { ...placement, origin: uprightPoint(placement, byInHeadset) };
}

/** Puts the operator's feet at a point of the upright world. */
export function teleported(placement: Placement, to: Vector3, head: Vector3): Placement {
  return fixedAt(placement, new Vector3(head.x, 0, head.z), to);
}

/** Where a ray of the headset's space meets a horizontal plane of the upright world, if it does within a distance. */
export function onFloor(placement: Placement, from: Vector3, direction: Vector3, floorM: number, maxM: number): Vector3 | null {
  const start = uprightPoint(placement, from);
  const along = uprightPoint(placement, from.clone().add(direction)).sub(start);
  if (along.z >= -1e-6) return null;
  const share = (floorM - start.z) / along.z;
  return share > 0 && share <= maxM ? start.addScaledVector(along, share) : null;
}

function middle([a, b]: readonly [Vector3, Vector3]): Vector3 {
  return a.clone().add(b).multiplyScalar(0.5);
}

/** Direction from the first point to the second one on the floor plan, radians, counterclockwise from above. */
function directionRad([a, b]: readonly [Vector3, Vector3]): number {
  return Math.atan2(-(b.z - a.z), b.x - a.x);
}

function flatSpan([a, b]: readonly [Vector3, Vector3]): number {
  return Math.hypot(b.x - a.x, b.z - a.z);
}
