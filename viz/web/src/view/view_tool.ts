// A tool that is drawn in the view, and that can take presses before the view moves.

import type { Object3D } from "three";

export interface ViewTool {
  readonly root: Object3D;
  /** Whether the last press was on the tool, and not on the rest of the view. */
  readonly hasTakenPress: boolean;
  /** Called before each drawing. */
  update(): void;
}
