// The classes of three.js that the page shares with the scripts that are loaded later. A second copy would be large, and its
// objects would have the same numbers as those of the page. tests/three_of_the_page.test.ts compares the list with the imports.

import * as THREE from "three";

const SHARED = {
  CanvasTexture: THREE.CanvasTexture,
  CapsuleGeometry: THREE.CapsuleGeometry,
  CylinderGeometry: THREE.CylinderGeometry,
  DataTexture: THREE.DataTexture,
  DirectionalLight: THREE.DirectionalLight,
  DoubleSide: THREE.DoubleSide,
  FloatType: THREE.FloatType,
  Group: THREE.Group,
  HemisphereLight: THREE.HemisphereLight,
  LinearFilter: THREE.LinearFilter,
  LinearMipmapLinearFilter: THREE.LinearMipmapLinearFilter,
  MathUtils: THREE.MathUtils,
  Matrix4: THREE.Matrix4,
  Mesh: THREE.Mesh,
  MeshBasicMaterial: THREE.MeshBasicMaterial,
  MeshLambertMaterial: THREE.MeshLambertMaterial,
  Object3D: THREE.Object3D,
  PerspectiveCamera: THREE.PerspectiveCamera,
  Plane: THREE.Plane,
  PlaneGeometry: THREE.PlaneGeometry,
  Quaternion: THREE.Quaternion,
  Raycaster: THREE.Raycaster,
  RedFormat: THREE.RedFormat,
  RingGeometry: THREE.RingGeometry,
  Scene: THREE.Scene,
  ShaderMaterial: THREE.ShaderMaterial,
  SphereGeometry: THREE.SphereGeometry,
  Texture: THREE.Texture,
  TorusGeometry: THREE.TorusGeometry,
  Vector2: THREE.Vector2,
  Vector3: THREE.Vector3,
};

/** To be called before such a script is loaded; see build.mjs. */
export function shareThree(): void {
  Object.assign(globalThis, { fieldrigThree: SHARED });
}
