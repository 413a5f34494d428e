// The data needed to show a view again.

/**
 * How the view moves. `overview`: it shows everything, and follows growing bounds until the user moves it. `chase`: it
 * moves with a frame of the robot. `ride`: it is attached to a camera.
 */
export type ViewMode = "overview" | "orbit" | "fly" | "chase" | "ride";

type Point = [number, number, number];

export interface ViewState {
  /** The eye and the point that it orbits, in world, meters. */
  position: Point;
  target: Point;
  /** Upward direction of the picture, in world. Only while riding on a camera, the view can be tilted sideways. */
  up: Point;
  mode: ViewMode;
  /** Vertical field of view, degrees; without it, the present one stays. */
  fovDegrees?: number;
  /** The followed frame in the mode `chase`, or the camera in the mode `ride`. */
  attachedTo?: string;
}

const MODES: readonly unknown[] = ["overview", "orbit", "fly", "chase", "ride"] satisfies ViewMode[];

/** Whether a text is the name of a mode. */
export function isViewMode(text: string): text is ViewMode {
  return MODES.includes(text);
}
