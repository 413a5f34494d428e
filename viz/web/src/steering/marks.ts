// Labels in the view, at the places where the arm is slowed or refused.

import * as THREE from "three";
import { element } from "../panels/element";
import { make } from "../panels/html";
import type { ViewTool } from "../view/view_tool";

/** A sentence about a place in the world. */
export interface Mark {
  worldPoint: THREE.Vector3;
  /** `slowed`, `refused` or `braked`. */
  effect: string;
  text: string;
}

/** A sign besides the color. */
const SIGNS: Record<string, string> = { slowed: "▲", refused: "✕", braked: "■" };

export class Marks implements ViewTool {
  readonly root = new THREE.Group();
  readonly hasTakenPress = false;
  private marks: readonly Mark[] = [];
  private shown = "[]";

  constructor(
    private readonly camera: THREE.PerspectiveCamera,
    private readonly canvas: HTMLCanvasElement,
    private readonly changed: () => void,
    private readonly list = element("steer-marks"),
  ) {}

  show(marks: readonly Mark[]): void {
    const key = JSON.stringify(marks);
    if (key === this.shown) return;
    this.shown = key;
    this.marks = marks;
    this.changed();
  }

  update(): void {
    while (this.list.children.length > this.marks.length) this.list.lastElementChild!.remove();
    const { clientWidth, clientHeight } = this.canvas;
    this.camera.updateMatrixWorld();
    for (const [ix, { worldPoint, effect, text }] of this.marks.entries()) {
      const label = (this.list.children[ix] as HTMLElement | undefined) ?? this.list.appendChild(make("span"));
      const { x, y, z } = worldPoint.clone().project(this.camera);
      label.hidden = Math.abs(z) > 1 || Math.abs(x) > 1 || Math.abs(y) > 1;
      label.dataset.effect = effect;
      const shown = `${SIGNS[effect] ?? "▲"} ${text}`;
      if (label.textContent !== shown) label.textContent = shown;
      label.style.translate = `${Math.round(0.5 * (1 + x) * clientWidth)}px ${Math.round(0.5 * (1 - y) * clientHeight)}px`;
    }
  }
}
