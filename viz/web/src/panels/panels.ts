// Panels below the toolbar; at most one is open.

import { action, closesWithEscape } from "../keys";
import { element } from "./element";
import { closePanel } from "./focus";

/** A panel and its button. */
export interface PanelEntry {
  button: string;
  panel: string;
  /** Called when the panel is opened or closed. */
  onToggle?: (isOpen: boolean) => void;
}

/** Opens and closes panels with their buttons. */
export function setUpPanels(entries: readonly PanelEntry[]): void {
  const showOnly = (shown: PanelEntry | null): void => {
    for (const entry of entries) {
      const panel = element(entry.panel);
      const isOpen = entry === shown;
      if (panel.hidden === !isOpen) continue;
      panel.hidden = !isOpen;
      element(entry.button).setAttribute("aria-expanded", String(isOpen));
      entry.onToggle?.(isOpen);
    }
  };
  for (const entry of entries) {
    const [panel, button] = [element(entry.panel), element(entry.button)];
    action(entry.button, () => showOnly(panel.hidden ? entry : null));
    // Escape closes the panel even if its button was disabled or hidden in the meantime.
    closesWithEscape("panel", () => !panel.hidden, () => closePanel(panel, button, () => showOnly(null)), panel);
  }
}
