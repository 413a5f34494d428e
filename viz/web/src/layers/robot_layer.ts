// The robot: links of a URDF, moved by the joint positions that the server sends.

import * as THREE from "three";
import { ColladaLoader } from "three/examples/jsm/loaders/ColladaLoader.js";
import { OBJLoader } from "three/examples/jsm/loaders/OBJLoader.js";
import { STLLoader } from "three/examples/jsm/loaders/STLLoader.js";
import { worldFromCamera as matrixOf } from "../view/convention";
import { type Occlusion, SOLID } from "./occlusion";
import type { PosedFrame } from "./overlays";
import type { Robot, RobotJoint, RobotShape, RobotState } from "../connection/protocol";

/** Color of shapes without one. */
const DEFAULT_COLOR = [0.72, 0.75, 0.79, 1] as const;
/** Opacity while the state is outdated. */
const OUTDATED_OPACITY = 0.35;
const N_SEGMENTS = 48;

interface MovingJoint {
  joint: RobotJoint;
  frame: THREE.Group;
  parentFromJoint: THREE.Matrix4;
  axis: THREE.Vector3;
}

export class RobotLayer {
  readonly root = new THREE.Group();
  private robot: Robot | null = null;
  private described = "";
  private joints: MovingJoint[] = [];
  private readonly links = new Map<string, THREE.Group>();
  private readonly materials = new Map<string, THREE.MeshLambertMaterial>();
  /** Writes only depth, so that a faint robot does not show its own inside. */
  private readonly depthOnly: THREE.MeshBasicMaterial;
  private base: THREE.Group | null = null;
  private isOutdated = false;
  private isEnabled = true;
  private hasState = false;

  constructor(private readonly occlusion: Occlusion, private readonly changed: () => void) {
    this.root.visible = false;
    this.root.matrixAutoUpdate = false;
    const material = new THREE.MeshBasicMaterial({ colorWrite: false, side: THREE.DoubleSide, visible: false });
    this.depthOnly = this.occlusion.apply(material, SOLID);
  }

  /** Whether the robot is drawn once its state is known. */
  set enabled(enabled: boolean) {
    this.isEnabled = enabled;
    this.root.visible = this.isEnabled && this.hasState;
  }

  /** Whether the robot is drawn. */
  get isVisible(): boolean {
    return this.root.visible;
  }

  /** Creates the links of a robot. */
  setRobot(robot: Robot): void {
    const described = JSON.stringify(robot);
    if (described === this.described) return;
    this.described = described;
    this.robot = robot;
    this.clear();
    for (const { name, shapes } of robot.links) {
      const link = new THREE.Group();
      link.name = name;
      for (const shape of shapes) this.addShape(link, shape);
      this.links.set(name, link);
    }
    const children = new Set<string>();
    for (const joint of robot.joints) {
      const parent = this.links.get(joint.parent);
      const child = this.links.get(joint.child);
      if (!parent || !child) continue;
      const frame = new THREE.Group();
      frame.matrixAutoUpdate = false;
      const parentFromJoint = matrixOf(joint.parent_from_joint);
      frame.matrix.copy(parentFromJoint);
      frame.add(child);
      parent.add(frame);
      children.add(joint.child);
      if (joint.kind !== "fixed") {
        this.joints.push({ joint, frame, parentFromJoint, axis: new THREE.Vector3(...joint.axis) });
      }
    }
    for (const [name, link] of this.links) if (!children.has(name)) this.root.add(link);
    this.base = this.links.get(robot.base_link) ?? null;
    this.changed();
  }

  /** Moves the robot. */
  setState(state: RobotState): void {
    if (!this.robot || !this.base) return;
    const positions = new Map(this.robot.joint_names.map((name, ix) => [name, state.positions[ix] ?? 0]));
    for (const { joint, frame, parentFromJoint, axis } of this.joints) {
      const position = positionOf(joint, this.robot.joints, positions);
      const motion = new THREE.Matrix4();
      if (joint.kind === "revolute") motion.makeRotationAxis(axis, position);
      else motion.makeTranslation(axis.x * position, axis.y * position, axis.z * position);
      frame.matrix.multiplyMatrices(parentFromJoint, motion);
    }
    // The pose of the base link is known, and the root of the tree follows from it.
    this.root.matrix.identity();
    this.root.updateMatrixWorld(true);
    this.root.matrix.multiplyMatrices(matrixOf(state.world_from_base), this.base.matrixWorld.clone().invert());
    this.root.updateMatrixWorld(true);
    this.hasState = true;
    this.enabled = this.isEnabled;
    this.changed();
  }

  /** Position of the last link that the joints move; null if the state is unknown. */
  get tip(): THREE.Vector3 | null {
    if (!this.robot || !this.hasState) return null;
    const last = this.robot.joint_names.at(-1);
    const child = this.robot.joints.find((joint) => joint.name === last)?.child ?? this.robot.base_link;
    const link = this.links.get(child);
    return link ? new THREE.Vector3().setFromMatrixPosition(link.matrixWorld) : null;
  }

  /** Poses of the links in the world; none if the state is unknown. */
  linkPoses(): [string, PosedFrame][] {
    const { isOutdated } = this;
    const posed = ({ matrixWorld: worldFromFrame }: THREE.Group): PosedFrame => ({ worldFromFrame, isOutdated });
    return this.hasState ? [...this.links].map(([name, link]) => [name, posed(link)]) : [];
  }

  /** Draws the robot faintly while its state is outdated. */
  setOutdated(isOutdated: boolean): void {
    if (isOutdated === this.isOutdated) return;
    this.isOutdated = isOutdated;
    for (const material of this.materials.values()) this.fade(material);
    this.depthOnly.visible = isOutdated;
    this.changed();
  }

  private clear(): void {
    this.root.traverse((object) => {
      if (object instanceof THREE.Mesh) object.geometry.dispose();
    });
    this.root.clear();
    this.links.clear();
    this.joints = [];
    this.hasState = false;
    this.root.visible = false;
  }

  private addShape(link: THREE.Group, shape: RobotShape): void {
    const pose = new THREE.Group();
    pose.matrixAutoUpdate = false;
    pose.matrix.copy(matrixOf(shape.link_from_shape));
    link.add(pose);
    const material = this.material(shape.color_srgba ?? DEFAULT_COLOR);
    if (shape.kind === "mesh") {
      pose.scale.set(...shape.scale);
      pose.matrix.scale(pose.scale);
      void this.loadMesh(pose, shape.url, shape.format, material);
    } else {
      this.addMesh(pose, geometryOf(shape), material);
    }
  }

  private async loadMesh(
    pose: THREE.Group,
    url: string,
    format: "stl" | "dae" | "obj",
    material: THREE.MeshLambertMaterial,
  ): Promise<void> {
    try {
      if (format === "stl") {
        this.addMesh(pose, await new STLLoader().loadAsync(url), material);
      } else if (format === "obj") {
        this.addObject(pose, await new OBJLoader().loadAsync(url), () => material);
      } else {
        const collada = await new ColladaLoader().loadAsync(url);
        if (!collada) throw new Error("not a COLLADA file");
        // The loader turns z-up files to y-up; URDF uses the file's axes.
        collada.scene.rotation.set(0, 0, 0);
        const own = (old: THREE.Material): THREE.Material => {
          const color = (old as THREE.MeshPhongMaterial).color;
          return color ? this.material([color.r, color.g, color.b, 1]) : material;
        };
        this.addObject(pose, collada.scene, own);
      }
    } catch (error) {
      console.warn(`cannot draw the mesh ${url}: ${String(error)}`);
    }
    this.root.updateMatrixWorld(true);
    this.changed();
  }

  private addMesh(parent: THREE.Object3D, geometry: THREE.BufferGeometry, material: THREE.Material): void {
    parent.add(new THREE.Mesh(geometry, material), new THREE.Mesh(geometry, this.depthOnly));
  }

  /** Adds the meshes of a loaded file with materials that hide occluded fragments. */
  private addObject(
    parent: THREE.Object3D,
    object: THREE.Object3D,
    replace: (old: THREE.Material) => THREE.Material,
  ): void {
    const meshes: THREE.Mesh[] = [];
    object.traverse((part) => {
      if (part instanceof THREE.Mesh) meshes.push(part);
    });
    for (const mesh of meshes) {
      const old = mesh.material as THREE.Material | THREE.Material[];
      mesh.material = Array.isArray(old) ? old.map(replace) : replace(old);
      mesh.add(new THREE.Mesh(mesh.geometry, this.depthOnly));
    }
    parent.add(object);
  }

  /** Shapes of one color share a material. */
  private material(color: readonly number[]): THREE.MeshLambertMaterial {
    const key = color.map((channel) => channel.toFixed(3)).join();
    let material = this.materials.get(key);
    if (!material) {
      const [red, green, blue, opacity] = color as [number, number, number, number];
      material = this.occlusion.apply(
        new THREE.MeshLambertMaterial({ color: new THREE.Color(red, green, blue), side: THREE.DoubleSide }),
        SOLID,
      );
      material.userData.opacity = opacity;
      this.fade(material);
      this.materials.set(key, material);
    }
    return material;
  }

  private fade(material: THREE.MeshLambertMaterial): void {
    const opacity = (material.userData.opacity as number) * (this.isOutdated ? OUTDATED_OPACITY : 1);
    material.opacity = opacity;
    material.transparent = opacity < 1;
  }
}

/** Position of a joint, following the joints that it mimics. */
function positionOf(joint: RobotJoint, joints: RobotJoint[], positions: Map<string, number>): number {
  let factor = 1;
  let offset = 0;
  let current = joint;
  // A chain of mimics is not longer than the list of joints.
  for (let n = 0; current.mimic && n < joints.length; n++) {
    const { source, multiplier } = current.mimic;
    offset += factor * current.mimic.offset;
    factor *= multiplier;
    const followed = joints.find((other) => other.name === source);
    if (!followed) break;
    current = followed;
  }
  return factor * (positions.get(current.name) ?? 0) + offset;
}

function geometryOf(shape: Exclude<RobotShape, { kind: "mesh" }>): THREE.BufferGeometry {
  switch (shape.kind) {
    case "box":
      return new THREE.BoxGeometry(...shape.size_m);
    case "sphere":
      return new THREE.SphereGeometry(shape.radius_m, N_SEGMENTS, N_SEGMENTS / 2);
    // Along y in three.js, along z in URDF.
    case "cylinder":
      return new THREE.CylinderGeometry(shape.radius_m, shape.radius_m, shape.length_m, N_SEGMENTS).rotateX(Math.PI / 2);
    case "capsule":
      return new THREE.CapsuleGeometry(shape.radius_m, shape.length_m, N_SEGMENTS / 4, N_SEGMENTS).rotateX(Math.PI / 2);
  }
}
