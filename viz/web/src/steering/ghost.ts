// The ghost: the robot at the target that it follows, or at the goal of a preview.

import * as THREE from "three";
import type { Look } from "../layers/link_look";
import { type Occlusion, SOLID } from "../layers/occlusion";
import type { RobotLayer } from "../layers/robot_layer";
import { type GhostLookName, LOOKS } from "./ghost_looks";
import { poseOfMatrix, type Pose } from "./pose";

/** Fragments that a pattern leaves out let the robot behind the ghost show through. Sizes in pixels of the window. */
const PATTERN = /* glsl */ `
  uniform int ghostPattern;
  uniform float ghostPixel;
  bool isGap() {
    ivec2 p = ivec2(gl_FragCoord.xy / ghostPixel);
    if (ghostPattern == 1) return (p.x + p.y) % 10 < 5;
    if (ghostPattern == 2) return (p.x + p.y) % 8 > 2 && (p.x - p.y + 8192) % 8 > 2;
    if (ghostPattern == 3) return p.x % 6 > 2 || p.y % 6 > 2;
    if (ghostPattern == 4) return p.x % 6 > 1;
    return p.x % 2 != p.y % 2;
  }`;

/** All links have one material, whose color and pattern say what is known about the pose. */
class GhostLook implements Look {
  outdated = false;
  private readonly shared: THREE.MeshLambertMaterial;
  private readonly pattern = { value: 0 };

  constructor(occlusion: Occlusion) {
    this.shared = occlusion.apply(new THREE.MeshLambertMaterial({ side: THREE.DoubleSide }), SOLID);
    const hideOccluded = this.shared.onBeforeCompile;
    this.shared.onBeforeCompile = (shader, renderer) => {
      hideOccluded.call(this.shared, shader, renderer);
      Object.assign(shader.uniforms, { ghostPattern: this.pattern, ghostPixel: { value: Math.min(devicePixelRatio, 2) } });
      shader.fragmentShader = `${PATTERN}\n${shader.fragmentShader}`.replace("void main() {", "void main() {\n  if (isGap()) discard;");
    };
    this.shared.customProgramCacheKey = () => "ghost";
  }

  show(name: GhostLookName): void {
    this.pattern.value = LOOKS[name].pattern;
    this.shared.color.setHex(LOOKS[name].color);
  }

  material(): THREE.MeshLambertMaterial {
    return this.shared;
  }

  add(): THREE.Object3D {
    return new THREE.Object3D();
  }

  fadeNear(): void {}
}

export interface GhostParts {
  /** Makes a layer for another copy of the robot. */
  newRobotLayer(changed: () => void, newLook: () => Look): RobotLayer;
}

export class Ghost {
  private readonly look: GhostLook;
  private readonly layer: RobotLayer;
  /** What is shown, as text: the view is drawn again only if it changes. */
  private shown = "";

  constructor(
    private readonly robot: RobotLayer,
    occlusion: Occlusion,
    { newRobotLayer }: GhostParts,
    private readonly changed: () => void,
  ) {
    this.look = new GhostLook(occlusion);
    this.layer = newRobotLayer(changed, () => this.look);
    this.layer.enabled = false;
  }

  get root(): THREE.Object3D {
    return this.layer.root;
  }

  /** Shows the robot with these positions of its joints, in the order of `names`. */
  show(names: readonly string[], positions: readonly number[], look: GhostLookName): void {
    const { state } = this.robot;
    const key = JSON.stringify([names, positions, look, state?.positions, state?.world_from_base]);
    if (key === this.shown || !this.pose(names, positions)) return;
    this.shown = key;
    this.look.show(look);
    this.layer.enabled = true;
    this.changed();
  }

  hide(): void {
    if (this.shown === "") return;
    this.shown = "";
    this.layer.enabled = false;
    this.changed();
  }

  /** Pose of a link in another one at these joint positions; null if the robot does not have them, or is unknown. */
  linkInLink(from: string, to: string, names: readonly string[], positions: readonly number[]): Pose | null {
    if (!this.pose(names, positions)) return null;
    this.shown = this.shown && "another pose";
    const [worldFromBase, worldFromTip] = [this.layer.linkPose(from), this.layer.linkPose(to)];
    return worldFromBase && worldFromTip && poseOfMatrix(worldFromBase.clone().invert().multiply(worldFromTip));
  }

  private pose(names: readonly string[], positions: readonly number[]): boolean {
    const { description, state } = this.robot;
    if (!description || !state) return false;
    this.layer.setRobot(description);
    // Joints that are not steered, such as those of a second arm, are where they are.
    const moved = description.joint_names.map((name, ix) => positions[names.indexOf(name)] ?? state.positions[ix] ?? 0);
    this.layer.setState({ ...state, positions: moved });
    return true;
  }
}
