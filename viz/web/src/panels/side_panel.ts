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
  // On phones, there is space for one sheet: a panel, the values of the run, or the list of "More". Panels are also opened
  // from the view and with keys, so that this depends on the states of the buttons and not on clicks.
  new MutationObserver((changes) => {
    const opened = changes.map(({ target }) => target as HTMLElement).filter(isExpanded).at(-1);
    if (opened && phones.matches) closeOthers(opened);
  }).observe(element("toolbar"), { subtree: true, attributeFilter: ["aria-expanded"] });
  const showFirst = (): void => show(!phones.matches && stored(HIDDEN_KEY, "sessionStorage") !== "true");
  phones.addEventListener("change", showFirst);
  showFirst();
}

function isExpanded(opener: HTMLElement): boolean {
  return opener.getAttribute("aria-expanded") === "true";
}

/** Closes all sheets except for the one of this button of the toolbar. */
function closeOthers(opened: HTMLElement): void {
  const openers = [...document.querySelectorAll<HTMLElement>("#toolbar [aria-controls]")];
  for (const opener of openers.filter((other) => other !== opened && isExpanded(other))) {
    // The toolbar closes the list of "More" after each click that it sees, but this list may be the one that was opened.
    opener.dispatchEvent(new MouseEvent("click", { bubbles: opener.id === "show-more" }));
  }
}
