// What the view lends to a headset, which draws it for both eyes while the page draws nothing.

import type * as THREE from "three";
import type { Scene } from "../connection/protocol";
import type { View } from "../connection/render_scheduler";
import type { Overlays } from "../layers/overlays";
import type { RobotLayer } from "../layers/robot_layer";
import type { SplatEyes } from "../layers/splat_layer";
import type { CropBox } from "./crop_box";

export interface EyeOptions {
  /** Whether the headset draws the model itself, with pictures of its own. */
  hasOwnPictures: boolean;
  /** Whether the real room is visible where there is no model. */
  hasPassthrough: boolean;
}

export interface LentView {
  readonly renderer: THREE.WebGLRenderer;
  /** Everything that is drawn. */
  readonly roots: readonly THREE.Object3D[];
  /** Pose of the camera of the page, as 16 numbers, row major. */
  readonly worldFromCamera: number[];
  readonly scene: Scene | null;
  readonly crop: CropBox;
  readonly robot: RobotLayer;
  readonly overlays: Overlays;
  /** Maps the z axis to the direction of up. */
  readonly worldFromUpright: THREE.Quaternion;
  /** Color of the background. */
  readonly background: THREE.ColorRepresentation;
  /** Whether the page has the model, so that no pictures are needed. */
  canDrawModel(): boolean;
  /** Whether the user wants to see the model. */
  showsModel(): boolean;
  /** Prepares to draw for the eyes of a headset. Returns what the page draws of the model. */
  prepare(view: View, eyes: SplatEyes, options: EyeOptions): "local" | "pictures" | "nothing";
  /** Ends the loan. The page draws again. */
  end(): void;
}
