// Panels below the toolbar; at most one is open.

import { closesWithEscape } from "../keys";
import { element } from "./element";

/** Opens and closes panels with their buttons: ids of the buttons, and of the panels. Returns the function for a press of a button. */
export function panels(ids: Record<string, string>): (button: string) => void {
  const press = (pressed: string): void => {
    for (const [button, id] of Object.entries(ids)) {
      const panel = element(id);
      const isOpen = button === pressed && panel.hidden;
      panel.hidden = !isOpen;
      element(button).setAttribute("aria-expanded", String(isOpen));
    }
  };
  for (const [button, id] of Object.entries(ids)) {
    closesWithEscape("panel", () => !element(id).hidden, () => {
      const hadFocus = element(id).contains(document.activeElement);
      element(button).click();
      if (hadFocus) element(button).focus();
    });
  }
  return press;
}
