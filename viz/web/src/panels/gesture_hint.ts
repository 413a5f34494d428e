// At the first visit, the three basic gestures are shown over the view until the user has made one.

import { isTouched } from "./devices";
import { element } from "./element";
import { basicGestures } from "./gestures";
import { child } from "./html";
import { store, stored } from "./storage";

/** Key under which the browser stores that the hint was shown. */
const SEEN_KEY = "gestures-seen";
/** After the first gesture, the hint stays this long for the other two. */
const AFTER_GESTURE_MILLIS = 3000;
/** Duration of the transition in styles/hints.css. */
const FADE_MILLIS = 1500;

/** Shows the hint unless this browser has shown it before. */
export function showGestureHint(): void {
  if (stored(SEEN_KEY) !== null) return;
  const hint = element("gesture-hint");
  const showWords = (): void => hint.replaceChildren(...basicGestures(isTouched() ? "touch" : "mouse").map(phrase));
  showWords();
  hint.hidden = false;
  const used = new AbortController();
  const use = (): void => {
    used.abort();
    showWords(); // Now, the device is known.
    window.setTimeout(() => fade(hint), AFTER_GESTURE_MILLIS);
  };
  for (const kind of ["pointerdown", "wheel", "keydown"] as const) {
    element("canvas").addEventListener(kind, use, { signal: used.signal, passive: true });
  }
}

function phrase([how, what]: [string, string]): HTMLElement {
  const made = child("span", `${how}: `);
  made.append(child("b", what));
  return made;
}

function fade(hint: HTMLElement): void {
  hint.classList.add("is-fading");
  window.setTimeout(() => (hint.hidden = true), FADE_MILLIS);
  store(SEEN_KEY, "1"); // Otherwise, the next visit shows it again.
}
