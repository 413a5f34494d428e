// A box that is rotated about the vertical axis through its center.

import { Box3, Matrix4, Vector3, Vector4 } from "three";

/** The box in a request: along the axes of the world, or of the frame `box`. */
export interface Crop {
  min_m: [number, number, number];
  max_m: [number, number, number];
  /** Pose of the frame `box`, row-major. */
  world_from_box?: number[];
}

/** Which of the six sides: 0, 1, 2 for x, y and z of the box. */
export interface Side {
  axis: 0 | 1 | 2;
  isMax: boolean;
}

const UP = new Vector3(0, 0, 1);

export class OrientedBox {
  /** The box before its rotation, in world, meters. */
  readonly unrotated = new Box3(new Vector3(-1, -1, -1), new Vector3(1, 1, 1));
  /** Rotation about the vertical axis through the center, radians. */
  yaw = 0;

  get center(): Vector3 {
    return this.unrotated.getCenter(new Vector3());
  }

  get size(): Vector3 {
    return this.unrotated.getSize(new Vector3());
  }

  set(center: Vector3, size: Vector3, yaw: number): void {
    this.unrotated.setFromCenterAndSize(center, size);
    this.yaw = yaw;
  }

  /** Direction of an axis of the box, in world. */
  direction(axis: 0 | 1 | 2): Vector3 {
    return new Vector3().setComponent(axis, 1).applyAxisAngle(UP, this.yaw);
  }

  /** Center of a side, in world. */
  sideCenter({ axis, isMax }: Side): Vector3 {
    const half = 0.5 * this.size.getComponent(axis);
    return this.center.addScaledVector(this.direction(axis), isMax ? half : -half);
  }

  /** Middle of the vertical edge at the largest x and y of the box, in world. */
  get edgeCenter(): Vector3 {
    const size = this.size;
    return this.center
      .addScaledVector(this.direction(0), 0.5 * size.x)
      .addScaledVector(this.direction(1), 0.5 * size.y);
  }

  /** Moves a side outward by `along`, in meters; the opposite side stays. Sides keep a minimum length. */
  moveSide({ axis, isMax }: Side, along: number, minSide: number): void {
    const { min, max } = this.unrotated;
    const outward = Math.max(along, minSide - this.size.getComponent(axis));
    if (this.yaw === 0) {
      // The opposite side keeps its exact coordinate.
      if (isMax) max.setComponent(axis, max.getComponent(axis) + outward);
      else min.setComponent(axis, min.getComponent(axis) - outward);
      return;
    }
    const size = this.size;
    const center = this.center.addScaledVector(this.direction(axis), (isMax ? 0.5 : -0.5) * outward);
    size.setComponent(axis, size.getComponent(axis) + outward);
    this.unrotated.setFromCenterAndSize(center, size);
  }

  get request(): Crop {
    if (this.yaw === 0) {
      return { min_m: this.unrotated.min.toArray(), max_m: this.unrotated.max.toArray() };
    }
    const half = this.size.multiplyScalar(0.5);
    const pose = new Matrix4().makeRotationZ(this.yaw).setPosition(this.center);
    return {
      world_from_box: pose.transpose().toArray(), // Row-major.
      min_m: half.clone().negate().toArray(),
      max_m: half.toArray(),
    };
  }
}

/** Upper three rows of the transform from world to the frame of a box. */
export function boxFromWorld({ world_from_box: rowMajor }: Crop): [Vector4, Vector4, Vector4] {
  const matrix = rowMajor ? new Matrix4().fromArray(rowMajor).transpose().invert() : new Matrix4();
  const { elements } = matrix; // Column-major.
  const row = (ix: number): Vector4 =>
    new Vector4(elements[ix], elements[4 + ix], elements[8 + ix], elements[12 + ix]);
  return [row(0), row(1), row(2)];
}
