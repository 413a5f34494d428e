// The numbers of the box that limits the view or is erased, so that it can be set exactly and by keyboard.

import { Vector3 } from "three";
import type { CropBox } from "../view/crop_box";
import { element } from "./element";

const CENTERS = ["box-center-x", "box-center-y", "box-center-z"] as const;
const SIZES = ["box-size-x", "box-size-y", "box-size-z"] as const;
const YAW = "box-yaw";

export class BoxPanel {
  private readonly panel = element("box-panel");

  constructor(private readonly box: CropBox) {
    for (const id of [...CENTERS, ...SIZES, YAW]) field(id).addEventListener("change", () => this.apply());
    element("box-reset").addEventListener("click", () => box.reset());
    box.onChange = () => this.show();
    this.show();
  }

  /** Shows the numbers of the box. */
  private show(): void {
    this.panel.hidden = !this.box.isVisible;
    const { center, size, yaw } = this.box.pose;
    for (const axis of [0, 1, 2] as const) {
      setNumber(CENTERS[axis], center.getComponent(axis), 3);
      setNumber(SIZES[axis], size.getComponent(axis), 3);
    }
    const degrees = (yaw * 180) / Math.PI;
    setNumber(YAW, degrees - 360 * Math.round(degrees / 360), 1);
  }

  /** Moves the box to the numbers. An empty or invalid field keeps its value. */
  private apply(): void {
    const { center, size, yaw } = this.box.pose;
    const vector = (ids: readonly string[], before: Vector3): Vector3 =>
      new Vector3(...ids.map((id, axis) => number(id, before.getComponent(axis), 3)));
    const degrees = number(YAW, (yaw * 180) / Math.PI, 1);
    this.box.setPose(vector(CENTERS, center), vector(SIZES, size), (degrees * Math.PI) / 180);
    this.show();
  }
}

function field(id: string): HTMLInputElement {
  return element(id, HTMLInputElement);
}

function setNumber(id: string, value: number, nDigits: number): void {
  const text = rounded(value, nDigits);
  if (field(id).value !== text) field(id).value = text;
}

/** The number in a field; `before` if the field is invalid or still shows that number. */
function number(id: string, before: number, nDigits: number): number {
  const { value, valueAsNumber } = field(id);
  const isUnchanged = value === rounded(before, nDigits);
  return Number.isFinite(valueAsNumber) && !isUnchanged ? valueAsNumber : before;
}

function rounded(value: number, nDigits: number): string {
  return value.toFixed(nDigits).replace(/^-(0\.0*)$/, "$1");
}
