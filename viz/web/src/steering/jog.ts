// Jogging: directions of keys, buttons and sticks, in the frame that the operator has chosen, as velocities in axes of the
// base. This file has no DOM.

import { Matrix4, Quaternion, Vector3 } from "three";
import type { ArmJoint, Intent, SteeredBase } from "./messages";

export type FrameName = "view" | "tool" | "base";

/** Speeds at full deflection and 100 %. The limits of the arm apply besides. */
const LINEAR_M_S = 0.25;
const ANGULAR_RAD_S = 0.8;
/** Speed of a joint at 100 %, relative to its limit. */
const JOINT_SHARE = 0.5;

/** Deflections from -1 to 1, in the words of a person who looks along the frame. */
export interface Deflection {
  right: number;
  forward: number;
  up: number;
  /** Rotations: about the axis to the right (nose up), forward (roll to the right) and up (turn to the left). */
  pitch: number;
  roll: number;
  yaw: number;
}

export const NO_DEFLECTION: Deflection = { right: 0, forward: 0, up: 0, pitch: 0, roll: 0, yaw: 0 };

/** Rotations from which the axes of a frame follow. */
export interface FrameRotations {
  /** Null if the pose of the robot in the world is unknown. */
  baseFromWorld: Quaternion | null;
  /** Of the three.js camera: x right, y up, z backward. */
  worldFromEye: Quaternion;
  baseFromTip: Quaternion;
}

/** The axes of a frame at one moment. */
export interface Axes {
  frame: FrameName;
  baseFromAxes: Quaternion;
}

/**
 * Axes of a frame in the base; null if they are unknown. Those of the view are x right, y forward, z up, so that "right" is
 * where the operator sees it. Callers keep the result while the dead-man switch is held: a view that moves with the robot would
 * otherwise bend the motion.
 */
export function axesOf(frame: FrameName, { baseFromWorld, worldFromEye, baseFromTip }: FrameRotations): Axes | null {
  if (frame === "base") return { frame, baseFromAxes: new Quaternion() };
  if (frame === "tool") return { frame, baseFromAxes: baseFromTip.clone() };
  if (!baseFromWorld) return null;
  const [right, up, back] = [new Vector3(), new Vector3(), new Vector3()];
  new Matrix4().makeRotationFromQuaternion(worldFromEye).extractBasis(right, up, back);
  const worldFromView = new Matrix4().makeBasis(right, back.negate(), up);
  return { frame, baseFromAxes: baseFromWorld.clone().multiply(new Quaternion().setFromRotationMatrix(worldFromView)) };
}

/** A direction in axes of the frame. The base has x forward and z up; tools have z forward and y down, as cameras. */
export function inFrame(frame: FrameName, right: number, forward: number, up: number): Vector3 {
  if (frame === "view") return new Vector3(right, forward, up);
  return frame === "base" ? new Vector3(forward, -right, up) : new Vector3(right, -up, forward);
}

/** Velocity of the tip in axes of the base. `speed` is 0 to 1. */
export function tipVelocity({ frame, baseFromAxes }: Axes, deflection: Deflection, speed: number): TipVelocity {
  const { right, forward, up, pitch, roll, yaw } = deflection;
  const scaled = (vector: Vector3, max: number): Vector3 =>
    vector.clampLength(0, 1).multiplyScalar(max * speed).applyQuaternion(baseFromAxes);
  return {
    linear: scaled(inFrame(frame, right, forward, up), LINEAR_M_S),
    angular: scaled(inFrame(frame, pitch, roll, yaw), ANGULAR_RAD_S),
  };
}

export interface TipVelocity {
  /** Meters per second. */
  linear: Vector3;
  /** Radians per second. */
  angular: Vector3;
}

export function tipIntent({ linear, angular }: TipVelocity): Intent {
  return { kind: "tip_velocity", linear_m_s: linear.toArray(), angular_rad_s: angular.toArray() };
}

/** Velocity of a base. One that cannot move sideways turns instead. `speed` is 0 to 1. */
export function baseIntent(base: SteeredBase, { forward, right, yaw }: Deflection, speed: number): Intent {
  const canStrafe = base.max_left_m_s > 0;
  const turn = Math.min(1, Math.max(-1, canStrafe ? yaw : yaw - right));
  return {
    kind: "base_velocity",
    forward_m_s: forward * speed * base.max_forward_m_s,
    left_m_s: canStrafe ? 0 - right * speed * base.max_left_m_s : 0,
    yaw_rad_s: turn * speed * base.max_yaw_rad_s,
  };
}

/** Velocities of the joints if one of them is jogged. */
export function jointVelocities(joints: readonly ArmJoint[], jogged: number, direction: number, speed: number): number[] {
  return joints.map(({ velocity }, ix) => (ix === jogged ? direction * speed * JOINT_SHARE * velocity : 0));
}

/** Positions after a motion at these velocities, within the limits of the joints. */
export function movedJoints(
  joints: readonly ArmJoint[],
  position: readonly number[],
  velocity: readonly number[],
  secs: number,
): number[] {
  return joints.map(({ lower, upper }, ix) => {
    const moved = (position[ix] ?? 0) + (velocity[ix] ?? 0) * secs;
    return Math.min(upper ?? Infinity, Math.max(lower ?? -Infinity, moved));
  });
}

export function isDeflected(deflection: Deflection): boolean {
  return Object.values(deflection).some((value) => value !== 0);
}

/** Directions of keys by their place on the keyboard, as those that fly the view. */
export const JOG_KEYS: Readonly<Record<string, Partial<Deflection>>> = {
  KeyW: { forward: 1 },
  KeyS: { forward: -1 },
  KeyA: { right: -1 },
  KeyD: { right: 1 },
  KeyE: { up: 1 },
  KeyQ: { up: -1 },
  ArrowUp: { pitch: 1 },
  ArrowDown: { pitch: -1 },
  ArrowLeft: { yaw: 1 },
  ArrowRight: { yaw: -1 },
  KeyZ: { roll: -1 },
  KeyC: { roll: 1 },
};

/** The sum of the directions of the held keys. */
export function deflectionOfKeys(codes: Iterable<string>): Deflection {
  const sum = { ...NO_DEFLECTION };
  for (const code of codes) {
    for (const [axis, value] of Object.entries(JOG_KEYS[code] ?? {})) sum[axis as keyof Deflection] += value;
  }
  return sum;
}
