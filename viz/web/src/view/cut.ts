// Cuts away the part of the model between the eye and its target, so that a wall does not hide it.

/** If no wall has stopped the eye, the cut leaves this fraction of the distance or of the scene's radius. */
const KEPT_FRAC = 0.5;
/** If a wall has stopped the eye, the cut leaves this fraction of the distance from the target to the wall. */
const KEPT_BEFORE_WALL_FRAC = 0.8;

export class Cut {
  /** Parts of the model that are in front of the target by more than this are cut away, meters. Null without a cut. */
  private keptM: number | null = null;

  get isOn(): boolean {
    return this.keptM !== null;
  }

  /** Begins with an eye at this distance from its target, `isAtWall` if a wall has stopped it there. */
  begin(distanceM: number, sceneRadiusM: number, isAtWall: boolean): void {
    this.keptM = isAtWall ? KEPT_BEFORE_WALL_FRAC * distanceM : KEPT_FRAC * Math.min(distanceM, sceneRadiusM);
  }

  /** Begins with a model that starts at this depth, for a target at this distance; meters. */
  beginAt(depthM: number, distanceM: number): void {
    this.keptM = distanceM - depthM;
  }

  end(): void {
    this.keptM = null;
  }

  /**
   * Depth at which the model begins if the target is at this distance, meters. It is at least the
   * depth of the near plane.
   */
  depthM(distanceM: number, nearM: number): number {
    return this.keptM === null ? nearM : Math.max(nearM, distanceM - this.keptM);
  }
}
