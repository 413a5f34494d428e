// Announces changes of the state to screen readers.

import { element } from "./element";

/** Says a text when the user is idle. */
export function announce(text: string): void {
  element("announcer").textContent = text;
}
