// Panels below the toolbar; at most one is open.

import { element } from "./element";

/** Opens and closes panels with their buttons: ids of the buttons, and of the panels. Returns the function for a press of a button. */
export function panels(ids: Record<string, string>): (button: string) => void {
  const toolbar = element("toolbar");
  // The toolbar may have several rows, depending on the width of the window.
  new ResizeObserver(() => {
    const top = toolbar.offsetTop + toolbar.offsetHeight + 6;
    for (const id of Object.values(ids)) {
      element(id).style.top = `${top}px`;
      element(id).style.maxHeight = `calc(100% - ${top + 12}px)`;
    }
  }).observe(toolbar);
  return (pressed) => {
    for (const [button, id] of Object.entries(ids)) {
      const panel = element(id);
      const isOpen = button === pressed && panel.hidden;
      panel.hidden = !isOpen;
      element(button).setAttribute("aria-expanded", String(isOpen));
    }
  };
}
