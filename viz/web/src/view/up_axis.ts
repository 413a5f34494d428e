// The direction that points up. Models of other programs often differ from the page, whose world is
// z up.

import * as THREE from "three";
import type { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { Axis } from "../connection/protocol";

export const AXES: readonly Axis[] = ["z", "-z", "y", "-y", "x", "-x"];

/** Rotation that maps z to this direction; for -z, a half turn about x, as `--up` does. */
export function uprightRotation(up: THREE.Vector3): THREE.Quaternion {
  if (up.z < -1 + 1e-9) return new THREE.Quaternion(1, 0, 0, 0);
  return new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 0, 1), up);
}

/** Direction of an axis of the model in the world of the page, on which the axis `served` of the model points up. */
export function upInWorld(served: Axis, axis: Axis): THREE.Vector3 {
  const modelFromWorld = uprightRotation(vector(served));
  return vector(axis).applyQuaternion(modelFromWorld.invert());
}

/** Makes the controls orbit around another direction of up. */
export function turnControls(controls: OrbitControls, up: THREE.Vector3): void {
  controls.object.up.copy(up);
  // The controls of three.js compute this rotation only when they are created.
  const { _quat, _quatInverse } = controls as unknown as Record<"_quat" | "_quatInverse", THREE.Quaternion>;
  _quat.setFromUnitVectors(up, new THREE.Vector3(0, 1, 0));
  _quatInverse.copy(_quat).invert();
}

/** Arguments of `fieldrig view` that show a file with this axis up. */
export function upCommand(path: string, axis: Axis): string {
  const isPlain = /^[A-Za-z0-9_./:=@%+,][A-Za-z0-9_./:=@%+,-]*$/.test(path);
  const quoted = isPlain ? path : `'${path.replaceAll("'", "'\\''")}'`;
  return `fieldrig view ${quoted} --up ${axis}`;
}

function vector(axis: Axis): THREE.Vector3 {
  const sign = axis.startsWith("-") ? -1 : 1;
  const letter = axis.slice(-1);
  return new THREE.Vector3(Number(letter === "x"), Number(letter === "y"), Number(letter === "z")).multiplyScalar(sign);
}
