// Poses of the hand: conversion, mapping between frames, and a limit of their speed.

import { type Matrix4, Quaternion, Vector3 } from "three";
import type { PoseNumbers } from "./messages";

/** A position in meters, and a rotation, in the frame that the name of the variable states. */
export interface Pose {
  position: Vector3;
  rotation: Quaternion;
}

/** Greatest speeds of a hand. */
export interface HandSpeed {
  metersPerSec: number;
  radPerSec: number;
}

/** The pose of seven numbers: x, y, z and a quaternion x, y, z, w. */
export function poseOf([x, y, z, ...quaternion]: PoseNumbers): Pose {
  return { position: new Vector3(x, y, z), rotation: new Quaternion(...quaternion).normalize() };
}

export function numbersOf({ position, rotation }: Pose): PoseNumbers {
  return [...position.toArray(), rotation.x, rotation.y, rotation.z, rotation.w];
}

/** The pose of a rigid transform. */
export function poseOfMatrix(matrix: Matrix4): Pose {
  const [position, rotation] = [new Vector3(), new Quaternion()];
  matrix.decompose(position, rotation, new Vector3());
  return { position, rotation };
}

/** The pose `aFromC` of `aFromB` and `bFromC`. */
export function composed(aFromB: Pose, bFromC: Pose): Pose {
  return {
    position: bFromC.position.clone().applyQuaternion(aFromB.rotation).add(aFromB.position),
    rotation: aFromB.rotation.clone().multiply(bFromC.rotation),
  };
}

export function inverse({ position, rotation }: Pose): Pose {
  const inverted = rotation.clone().invert();
  return { position: position.clone().negate().applyQuaternion(inverted), rotation: inverted };
}

/**
 * The pose that a hand reaches within a time on its way to another one. A pointer can jump across the scene within one
 * sample; the server takes such a jump for a fault of the tracking.
 */
export function slewed(from: Pose, to: Pose, secs: number, { metersPerSec, radPerSec }: HandSpeed): Pose {
  const [meters, rad] = [from.position.distanceTo(to.position), from.rotation.angleTo(to.rotation)];
  // One share for both, so that the hand moves along the straight way.
  const share = Math.min(1, (metersPerSec * secs) / Math.max(meters, 1e-9), (radPerSec * secs) / Math.max(rad, 1e-9));
  return {
    position: from.position.clone().lerp(to.position, share),
    rotation: from.rotation.clone().slerp(to.rotation, share),
  };
}

/** The pose after a motion at constant velocity, which is in axes of the frame of the pose. */
export function integrated({ position, rotation }: Pose, linear: Vector3, angular: Vector3, secs: number): Pose {
  const angle = angular.length() * secs;
  const turn = new Quaternion().setFromAxisAngle(angle === 0 ? new Vector3(0, 0, 1) : angular.clone().normalize(), angle);
  return { position: position.clone().addScaledVector(linear, secs), rotation: turn.multiply(rotation).normalize() };
}
