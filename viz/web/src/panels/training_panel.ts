// The panel with scores and steps. Whether it is open is remembered. On small screens, it is closed at first.

import type { Status } from "../connection/protocol";
import { element } from "./element";
import { store, stored } from "./storage";

/** Key under which the browser stores whether the panel is open. */
const KEY = "training-panel";
const SMALL_SCREEN = "(max-width: 820px), (max-height: 500px)";

export class TrainingPanel {
  private readonly panel = element("training", HTMLDetailsElement);

  constructor() {
    const chosen = stored(KEY);
    this.panel.open = chosen === null ? !window.matchMedia(SMALL_SCREEN).matches : chosen === "open";
    // The event for the change above comes later, and stores nothing, because only clicks are choices.
    element("training-summary").addEventListener("click", () => store(KEY, this.panel.open ? "closed" : "open"));
  }

  /** Hides the panel for saved models, which are not trained. */
  show({ state }: Status): void {
    this.panel.hidden = state === "viewing";
  }
}
