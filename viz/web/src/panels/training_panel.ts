// The panel with scores and steps. Whether it is open is remembered. On small screens, it is closed at first.

import type { Status } from "../connection/protocol";
import { element } from "./element";

/** Key under which the browser stores whether the panel is open. */
const KEY = "training-panel";
const SMALL_SCREEN = "(max-width: 820px), (max-height: 500px)";

export class TrainingPanel {
  private readonly panel = element("training", HTMLDetailsElement);

  constructor() {
    const stored = read();
    this.panel.open = stored === null ? !window.matchMedia(SMALL_SCREEN).matches : stored === "open";
    // The event for the change above comes later, and stores nothing, because only clicks are choices.
    element("training-summary").addEventListener("click", () => write(this.panel.open ? "closed" : "open"));
  }

  /** Hides the panel for saved models, which are not trained. */
  show({ state }: Status): void {
    this.panel.hidden = state === "viewing";
  }
}

function read(): string | null {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // The browser stores nothing for this page.
  }
}

function write(state: "open" | "closed"): void {
  try {
    localStorage.setItem(KEY, state);
  } catch {
    // The panel is as at first when the page is reloaded.
  }
}
