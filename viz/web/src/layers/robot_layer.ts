// The robot: links of a URDF, moved by the joint positions that the server sends.

import * as THREE from "three";
import { worldFromCamera as matrixOf } from "../view/convention";
import { LinkLook, type Look } from "./link_look";
import type { MeshPart } from "./mesh_loaders";
import type { Occlusion } from "./occlusion";
import type { PosedFrame } from "./overlays";
import type { Robot, RobotJoint, RobotShape, RobotState } from "../connection/protocol";

/** Color of shapes without one. */
const DEFAULT_COLOR = [0.72, 0.75, 0.79, 1] as const;
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
  private readonly looks = new Map<string, Look>();
  private base: THREE.Group | null = null;
  private isOutdated = false;
  private isEnabled = true;
  private hasState = false;
  /** The last state; null before the first one. */
  state: RobotState | null = null;
  /** Whether the present server has not described this robot. */
  isOld = false;

  /** `newLook` makes the look of each link. */
  constructor(
    occlusion: Occlusion,
    private readonly changed: () => void,
    private readonly newLook: () => Look = () => new LinkLook(occlusion),
  ) {
    this.root.visible = false;
    this.root.matrixAutoUpdate = false;
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
    this.isOld = false;
    const described = JSON.stringify(robot);
    if (described === this.described) return;
    this.described = described;
    this.robot = robot;
    this.clear();
    for (const { name, shapes } of robot.links) {
      const link = new THREE.Group();
      link.name = name;
      const look = this.newLook();
      look.outdated = this.isOutdated;
      this.looks.set(name, look);
      for (const shape of shapes) this.addShape(link, look, shape);
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
    this.state = state;
    this.enabled = this.isEnabled;
    this.changed();
  }

  /** The robot that is drawn; null before it is known. */
  get description(): Robot | null {
    return this.robot;
  }

  /** The link whose pose is sent, and the last link that the joints move; null before the robot is known. */
  get namedLinks(): { base: string; tool: string } | null {
    if (!this.robot) return null;
    const last = this.robot.joint_names.at(-1);
    const child = this.robot.joints.find((joint) => joint.name === last)?.child;
    return { base: this.robot.base_link, tool: child ?? this.robot.base_link };
  }

  /** Names of all links. */
  get linkNames(): string[] {
    return [...this.links.keys()];
  }

  /** Pose of a link in the world; null if it is unknown. */
  linkPose(name: string): THREE.Matrix4 | null {
    return (this.hasState && this.links.get(name)?.matrixWorld) || null;
  }

  /** A box around the robot in the world; empty if its state is unknown. */
  box(): THREE.Box3 {
    const box = new THREE.Box3();
    if (!this.hasState) return box;
    box.setFromObject(this.root);
    for (const link of this.links.values()) box.expandByPoint(new THREE.Vector3().setFromMatrixPosition(link.matrixWorld));
    return box;
  }

  /** Fades the links that are close to the eye. */
  fadeNear(eye: THREE.Vector3): void {
    for (const look of this.looks.values()) look.fadeNear(eye);
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
    for (const look of this.looks.values()) look.outdated = isOutdated;
    this.changed();
  }

  /** Removes the robot of another run. */
  forgetRun(): void {
    if (!this.isOld) return;
    this.clear();
    this.robot = null;
    this.described = "";
  }

  private clear(): void {
    this.root.traverse((object) => {
      if (object instanceof THREE.Mesh) object.geometry.dispose();
    });
    this.root.clear();
    this.links.clear();
    this.looks.clear();
    this.joints = [];
    this.hasState = false;
    this.state = null;
    this.root.visible = false;
  }

  private addShape(link: THREE.Group, look: Look, shape: RobotShape): void {
    const pose = new THREE.Group();
    pose.matrixAutoUpdate = false;
    pose.matrix.copy(matrixOf(shape.link_from_shape));
    link.add(pose);
    const material = look.material(shape.color_srgba ?? DEFAULT_COLOR);
    if (shape.kind === "mesh") {
      pose.scale.set(...shape.scale);
      pose.matrix.scale(pose.scale);
      void this.loadMesh(pose, look, shape, material);
    } else {
      addMesh(pose, look, geometryOf(shape), material);
    }
  }

  private async loadMesh(
    pose: THREE.Group,
    look: Look,
    { url, format }: RobotShape & { kind: "mesh" },
    material: THREE.MeshLambertMaterial,
  ): Promise<void> {
    try {
      const { loadMeshes } = await import("./mesh_loaders");
      for (const part of await loadMeshes(url, format)) addPart(pose, look, part, material);
    } catch (error) {
      console.warn(`cannot draw the mesh ${url}: ${String(error)}`);
    }
    this.root.updateMatrixWorld(true);
    this.changed();
  }
}

function addMesh(parent: THREE.Object3D, look: Look, geometry: THREE.BufferGeometry, material: THREE.Material): void {
  const mesh = new THREE.Mesh(geometry, material);
  parent.add(mesh, look.add(mesh));
}

/** Adds a mesh of a file, in its own colors if it has some. */
function addPart(parent: THREE.Object3D, look: Look, part: MeshPart, material: THREE.Material): void {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(part.positions, 3));
  if (part.normals) geometry.setAttribute("normal", new THREE.BufferAttribute(part.normals, 3));
  if (part.indices) geometry.setIndex(new THREE.BufferAttribute(part.indices, 1));
  for (const { start, count, colorIx } of part.groups) geometry.addGroup(start, count, colorIx);
  const materials = part.colors.map((color) => (color ? look.material([...color, 1]) : material));
  const mesh = new THREE.Mesh(geometry, part.groups.length > 0 ? materials : materials[0]);
  mesh.matrixAutoUpdate = false;
  mesh.matrix.fromArray(part.fileFromPart);
  mesh.add(look.add(mesh));
  parent.add(mesh);
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
    // Cylinders are along y in three.js, and along z in URDF.
    case "cylinder":
      return new THREE.CylinderGeometry(shape.radius_m, shape.radius_m, shape.length_m, N_SEGMENTS).rotateX(Math.PI / 2);
    case "capsule":
      return new THREE.CapsuleGeometry(shape.radius_m, shape.length_m, N_SEGMENTS / 4, N_SEGMENTS).rotateX(Math.PI / 2);
  }
}
