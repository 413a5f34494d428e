// The panel with scores and steps. Whether it is open is remembered. In small windows, it is closed at first.

import type { Status } from "../connection/protocol";
import { element } from "./element";
import { store, stored } from "./storage";
import { SMALL_WINDOW } from "./windows";

/** Key under which the browser stores whether the panel is open. */
const KEY = "training-panel";

export class TrainingPanel {
  private readonly panel = element("training", HTMLDetailsElement);

  constructor() {
    const chosen = stored(KEY);
    this.panel.open = chosen === null ? !window.matchMedia(SMALL_WINDOW).matches : chosen === "open";
    // The event for the change above comes later, and stores nothing, because only clicks are choices.
    element("training-summary").addEventListener("click", () => store(KEY, this.panel.open ? "closed" : "open"));
  }

  /** Hides the panel for saved models, which are not trained. */
  show({ state }: Status): void {
    this.panel.hidden = state === "viewing";
  }
}
