// Keys of the focused view: arrow keys orbit, with Shift they pan, plus and minus zoom.

import type { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

/** Angle per press of a key, radians. */
const ORBIT_RAD = Math.PI / 36;
/** Distance per press, relative to the height of the view. */
const PAN_FRAC = 0.05;
/** Factor of the distance to the target per step closer. */
const ZOOM = 0.9;

/** Motion of the view by one press, in steps to the right, up, and closer. */
export interface ViewStep {
  kind: "orbit" | "pan" | "zoom";
  right: number;
  up: number;
  closer: number;
}

type Press = Pick<KeyboardEvent, "key" | "shiftKey" | "ctrlKey" | "metaKey" | "altKey">;

const ARROWS: Record<string, [right: number, up: number]> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

/** The step of a key; null if it has another meaning. */
export function viewStep({ key, shiftKey, ctrlKey, metaKey, altKey }: Press): ViewStep | null {
  if (ctrlKey || metaKey || altKey) return null;
  const arrow = ARROWS[key];
  if (arrow) return { kind: shiftKey ? "pan" : "orbit", right: arrow[0], up: arrow[1], closer: 0 };
  const closer = ["+", "="].includes(key) ? 1 : ["-", "_"].includes(key) ? -1 : 0;
  return closer === 0 ? null : { kind: "zoom", right: 0, up: 0, closer };
}

/** Lets keys move the view while it has the focus. */
export function listenToViewKeys(canvas: HTMLCanvasElement, controls: OrbitControls): void {
  canvas.addEventListener("keydown", (event) => {
    const step = controls.enabled ? viewStep(event) : null;
    if (!step) return;
    event.preventDefault();
    controls.dispatchEvent({ type: "start" }); // As the other motions by the user.
    move(controls, step, canvas.clientHeight);
    controls.dispatchEvent({ type: "end" });
  });
}

/** Moves the eye to the right and up, so that the scene moves the other way. */
function move(controls: OrbitControls, { kind, right, up, closer }: ViewStep, heightPx: number): void {
  if (kind === "orbit") {
    if (right !== 0) controls.rotateLeft(-right * ORBIT_RAD);
    if (up !== 0) controls.rotateUp(up * ORBIT_RAD);
  } else if (kind === "pan") {
    controls.pan(-right * PAN_FRAC * heightPx, up * PAN_FRAC * heightPx);
  } else if (closer > 0) {
    controls.dollyIn(ZOOM);
  } else {
    controls.dollyOut(ZOOM);
  }
}
