// Buttons that jog the hand or a joint while they are held: for fingers, and for everybody without a gizmo in view.

import { element } from "../panels/element";
import { child, make, setText } from "../panels/html";
import type { Commander, Jog } from "./commander";
import { holdButton } from "./hold_button";
import type { ArmJoint } from "./messages";
import { type Deflection, NO_DEFLECTION } from "./jog";
import { jointText } from "./texts";

/** Directions in which a base can also be jogged. */
const ON_FLOOR: readonly (keyof Deflection)[] = ["right", "forward", "yaw"];

/** Pairs of directions: the names of both, and the deflection of the first. */
const PAIRS: readonly [minus: string, plus: string, axis: keyof Deflection][] = [
  ["Left", "Right", "right"],
  ["Back", "Forward", "forward"],
  ["Down", "Up", "up"],
  ["Nose down", "Nose up", "pitch"],
  ["Roll left", "Roll right", "roll"],
  ["Turn right", "Turn left", "yaw"],
];

/** Whether the buttons of one arm fit the other. Each connection describes its arm anew. */
function haveSameButtons(a: readonly ArmJoint[], b: readonly ArmJoint[]): boolean {
  const isSame = ({ name, is_prismatic }: ArmJoint, ix: number): boolean => name === b[ix]?.name && is_prismatic === b[ix].is_prismatic;
  return a.length === b.length && a.every(isSame);
}

export class JogPad {
  private joints: readonly ArmJoint[] = [];
  private values: HTMLElement[] = [];

  constructor(private readonly commander: Commander) {
    const tip = element("steer-tip");
    for (const [minus, plus, axis] of PAIRS) {
      const jog = (value: number): Jog => ({ kind: "tip", deflection: { ...NO_DEFLECTION, [axis]: value } });
      const buttons = [this.button(minus, minus, jog(-1)), this.button(plus, plus, jog(1))];
      for (const button of buttons) button.classList.toggle("of-arm", !ON_FLOOR.includes(axis));
      tip.append(...buttons);
    }
  }

  /** Shows the positions of the joints. Other joints get other buttons. */
  show(): void {
    const { arm, state } = this.commander;
    if (arm && !haveSameButtons(arm.joints, this.joints)) this.build(arm.joints);
    for (const [ix, { is_prismatic }] of this.joints.entries()) {
      const position = state?.position[ix];
      if (position !== undefined) setText(this.values[ix]!, jointText(position, is_prismatic));
    }
  }

  private build(joints: readonly ArmJoint[]): void {
    this.joints = joints;
    this.values = joints.map(() => make("span"));
    const rows = joints.map(({ name }, ix) => {
      const row = make("div");
      const jog = (direction: number): Jog => ({ kind: "joint", ix, direction });
      row.append(child("span", name), this.button("−", `${name} backward`, jog(-1)));
      row.append(this.values[ix]!, this.button("+", `${name} forward`, jog(1)));
      return row;
    });
    element("steer-joints").replaceChildren(...rows);
  }

  private button(textContent: string, ariaLabel: string, jog: Jog): HTMLButtonElement {
    const button = make("button", { textContent, ariaLabel, className: "steer-hold", type: "button" });
    holdButton(button, (isHeld) => this.commander.setJog("button", isHeld ? jog : null));
    return button;
  }
}
