// Steering with the hands in a headset: the same commander, with poses in the world.

import { element } from "../panels/element";
import type { Commander } from "./commander";
import { draggedGoal, type Place } from "./floor_goal";
import { composed, inverse, type Pose, poseOf } from "./pose";

export class HandSteering {
  constructor(
    private readonly commander: Commander,
    private readonly worldFromBase: () => Pose | null,
    private readonly show: () => void,
  ) {}

  get hasControl(): boolean {
    return this.commander.hasControl;
  }

  get maySteer(): boolean {
    return this.commander.maySteer;
  }

  get canMove(): boolean {
    return this.commander.canMove;
  }

  /** Whether a base is steered instead of an arm. */
  get isBase(): boolean {
    return this.commander.arm?.base != null;
  }

  /** Height of the base link in the world, meters. */
  get baseHeightM(): number {
    return this.worldFromBase()?.position.z ?? 0;
  }

  /** Whether "go" would move the robot to its goal. */
  get mayGo(): boolean {
    const { commander } = this;
    return this.isBase ? commander.mayGoToBaseGoal : commander.goal.intent !== null || commander.deadMan.source === "go";
  }

  get hasGoal(): boolean {
    return this.isBase ? this.commander.baseGoal !== null : this.commander.goal.target !== null;
  }

  /** The operator uses the headset. */
  used(): void {
    this.commander.used(performance.now());
  }

  stop(): void {
    this.commander.stop();
  }

  /** Begins to move the tip, or the goal. Returns where it is in the world, or null if it does not follow. */
  begin(): Pose | null {
    const base = this.worldFromBase();
    if (!base || this.isBase || !this.commander.beginDrag()) return null;
    this.show();
    const tip = this.commander.gizmo ?? (this.commander.state && poseOf(this.commander.state.base_from_tip));
    return tip && composed(base, tip);
  }

  /** Moves the tip, or the goal, to a pose in the world. */
  move(worldFromTip: Pose): void {
    const base = this.worldFromBase();
    if (base) this.commander.dragTo(composed(inverse(base), worldFromTip));
  }

  end(): void {
    this.commander.endDrag();
  }

  /** Ends whatever the hands hold, for a reason other than its release. */
  interrupt(reason: string): void {
    this.commander.interrupt(reason);
    this.commander.endDrag();
    this.commander.setGo(false);
  }

  setGo(isHeld: boolean): void {
    this.commander.setGo(isHeld);
  }

  /** Sets the goal of the base: its place, and a second place in the direction that the base should face. */
  placeGoal(from: Place, to: Place): void {
    const heading = this.commander.state?.base?.world_from_base?.[2] ?? 0;
    this.commander.setBaseGoal(draggedGoal(from, to, heading));
    this.show();
  }

  /** Removes the goal. */
  discard(): void {
    element("steer-discard").click();
  }
}
