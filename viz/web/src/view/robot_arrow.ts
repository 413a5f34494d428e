// An arrow at the border of the view that points to the robot while it is off screen.

import { type Box3, type PerspectiveCamera, Vector3 } from "three";
import { element } from "../panels/element";
import { clearBottomPx } from "./clear_part";

/** Distance of the arrow's center from the edges of the view, pixels. Toolbars and images must not cover the arrow. */
const INSET_PX = { x: 34, top: 96, bottom: 84 };

export interface ArrowPlace {
  x: number;
  y: number;
  /** Direction on the screen, clockwise from right. */
  angleRad: number;
}

/** Eyes at most this far from the robot's box, in shares of its diagonal, look from the robot, such as from its camera. */
const SEAT_FRAC = 0.1;

/** Where the arrow is in a view of this size; null if a part of the box is visible, or the eye is on the robot. */
export function arrowPlace(box: Box3, camera: PerspectiveCamera, [width, height]: [number, number]): ArrowPlace | null {
  if (box.isEmpty() || isInView(box, camera)) return null;
  const diagonal = box.getSize(new Vector3()).length();
  if (box.distanceToPoint(camera.position) <= SEAT_FRAC * diagonal) return null;
  const center = box.getCenter(new Vector3()).applyMatrix4(camera.matrixWorldInverse);
  // Pixels are square, so this is the direction on the screen. It is also the way to turn if the robot is behind.
  const isStraightBehind = Math.hypot(center.x, center.y) < 1e-6;
  const [right, down] = isStraightBehind ? [0, 1] : [center.x, -center.y];
  const halfWidth = Math.max(1, 0.5 * width - INSET_PX.x);
  const top = Math.max(1, 0.5 * height - INSET_PX.top);
  const bottom = Math.max(1, 0.5 * height - INSET_PX.bottom);
  const share = Math.min(halfWidth / Math.abs(right), (down < 0 ? top : bottom) / Math.abs(down));
  return { x: 0.5 * width + share * right, y: 0.5 * height + share * down, angleRad: Math.atan2(down, right) };
}

/** Whether the picture shows a part of a box: its center or one of the points between center and corners. */
function isInView(box: Box3, camera: PerspectiveCamera): boolean {
  const center = box.getCenter(new Vector3());
  const half = box.getSize(new Vector3()).multiplyScalar(0.5);
  const signs = [-1, 0, 1];
  return signs.some((x) =>
    signs.some((y) => signs.some((z) => isVisible(new Vector3(x, y, z).multiply(half).add(center), camera))),
  );
}

function isVisible(point: Vector3, camera: PerspectiveCamera): boolean {
  const isInFront = point.clone().applyMatrix4(camera.matrixWorldInverse).z < 0;
  const { x, y } = point.project(camera);
  return isInFront && Math.abs(x) <= 1 && Math.abs(y) <= 1;
}

export class RobotArrow {
  private readonly button = element("robot-arrow", HTMLButtonElement);

  constructor(showOverview: () => void) {
    this.button.addEventListener("click", showOverview);
  }

  /** Places or hides the arrow. */
  show(place: ArrowPlace | null): void {
    this.button.hidden = place === null;
    if (!place) return;
    const lowest = clearBottomPx(element("canvas")) - INSET_PX.x;
    this.button.style.translate = `${Math.round(place.x)}px ${Math.round(Math.min(place.y, lowest))}px`;
    this.button.style.setProperty("--angle", `${place.angleRad.toFixed(3)}rad`);
  }
}
