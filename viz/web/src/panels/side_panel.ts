// The side panel with the values of the run: open beside the view, but a sheet over the view on phones.

import { action, closesWithEscape } from "../keys";
import { element } from "./element";
import { closePanel } from "./focus";
import { store, stored } from "./storage";
import { PHONE } from "./windows";

const phones = matchMedia(PHONE);
/** Key under which the tab stores whether the user has hidden the panel. */
const HIDDEN_KEY = "side-panel-hidden";

export function setUpSidePanel(): void {
  const panel = element("run");
  const show = (isOpen: boolean): void => {
    panel.hidden = !isOpen;
    element("toggle-run").setAttribute("aria-expanded", String(isOpen));
  };
  action("toggle-run", () => {
    show(panel.hidden === true);
    // A phone has no space for the panel, which says nothing about what the user wants beside a view.
    if (!phones.matches) store(HIDDEN_KEY, String(panel.hidden), "sessionStorage");
  });
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
  const showFirst = (): void => show(!phones.matches && stored(HIDDEN_KEY, "sessionStorage") !== "true");
  phones.addEventListener("change", showFirst);
  showFirst();
}

/** The buttons of the panels of the toolbar that are open. */
function openPanels(): NodeListOf<HTMLElement> {
  return document.querySelectorAll<HTMLElement>(
    "#toolbar [aria-controls][aria-expanded='true']:not(#toggle-run, #show-more)",
  );
}
