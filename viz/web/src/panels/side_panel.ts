// The side panel with the values of the run: open beside the view, but a sheet over the view on phones.

import { action, closesWithEscape } from "../keys";
import { element } from "./element";
import { closePanel } from "./focus";
import { PHONE } from "./windows";

const phones = matchMedia(PHONE);

export function setUpSidePanel(): void {
  const panel = element("run");
  const show = (isOpen: boolean): void => {
    panel.hidden = !isOpen;
    element("toggle-run").setAttribute("aria-expanded", String(isOpen));
  };
  action("toggle-run", () => show(panel.hidden === true));
  const close = (): void => closePanel(panel, element("toggle-run"), () => show(false));
  closesWithEscape("panel", () => phones.matches && !panel.hidden, close, panel);
  // On phones, there is space for one panel.
  element("toolbar").addEventListener("click", (event) => {
    if (!phones.matches || !(event.target instanceof Element)) return;
    const opener = event.target.closest("[aria-controls]");
    if (!opener || opener.id === "show-more") return;
    const isRunOpen = opener.id === "toggle-run" && !panel.hidden;
    const isOpened = opener.getAttribute("aria-expanded") === "true";
    for (const other of openPanels()) if (isOpened && other !== opener) other.click();
    show(isRunOpen);
  });
  phones.addEventListener("change", () => show(!phones.matches));
  show(!phones.matches);
}

/** The buttons of the panels of the toolbar that are open. */
function openPanels(): NodeListOf<HTMLElement> {
  return document.querySelectorAll<HTMLElement>(
    "#toolbar [aria-controls][aria-expanded='true']:not(#toggle-run, #show-more)",
  );
}
