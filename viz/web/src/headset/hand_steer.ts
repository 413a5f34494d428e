// Steers the robot by hand: the clutch of the arm, in the world, and the goal of a base.

import * as THREE from "three";
import type { HandSteering } from "../steering/hand_steering";
import { HandClutch, type HandPose } from "./hand_clutch";
import type { Hand } from "./hand_input";

export class HandSteer {
  private readonly clutch: HandClutch;
  /** Where the trigger was pulled that places a goal, on the floor. */
  private goalFrom: THREE.Vector3 | null = null;
  private isGoalDown = false;

  /** `steering` returns null if the robot cannot be steered. */
  constructor(private readonly steering: () => HandSteering | null) {
    this.clutch = new HandClutch({
      begin: () => this.steering()?.begin() ?? null,
      move: (tip) => this.steering()?.move(tip),
      end: () => this.steering()?.end(),
      interrupt: (reason) => this.steering()?.interrupt(reason),
    });
  }

  get isClosed(): boolean {
    return this.clutch.isClosed;
  }

  /** Follows a hand; null while it is not tracked. `isOn`: whether its trigger is the clutch. */
  update(hand: Hand | null, worldFromHeadset: THREE.Matrix4, isOn: boolean): void {
    if (!isOn && !this.clutch.isClosed) {
      // A trigger that is held when the clutch becomes possible must be pulled again.
      this.clutch.ignore(hand?.isTrigger ?? true);
      return;
    }
    this.clutch.update(hand && poseInWorld(hand, worldFromHeadset), hand?.isTrigger ?? false);
    if (this.clutch.isClosed) this.steering()?.used();
  }

  /** Places the goal of a base where a trigger is pulled, and turns it toward where the ray is drawn. */
  placeGoal(onFloor: THREE.Vector3 | null, isDown: boolean): void {
    if (isDown && !this.isGoalDown) this.goalFrom = onFloor;
    if (!isDown) this.goalFrom = null;
    this.isGoalDown = isDown;
    const { goalFrom } = this;
    if (goalFrom && onFloor) this.steering()?.placeGoal([goalFrom.x, goalFrom.y], [onFloor.x, onFloor.y]);
  }

  /** Opens the clutch. */
  interrupt(reason: string): void {
    if (this.clutch.isClosed) this.clutch.open(reason);
    this.goalFrom = null;
  }

  dispose(): void {
    this.interrupt("the headset was left");
  }
}

function poseInWorld(hand: Hand, worldFromHeadset: THREE.Matrix4): HandPose {
  const [position, rotation] = [new THREE.Vector3(), new THREE.Quaternion()];
  worldFromHeadset.clone().multiply(hand.grip).decompose(position, rotation, new THREE.Vector3());
  return { position, rotation };
}
