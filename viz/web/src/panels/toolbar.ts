// The toolbar. Its buttons keep their places when other buttons appear. On phones, "More" shows the
// buttons that do not fit in the bar.

import { closesWithEscape } from "../keys";
import { element } from "./element";

const STEPS: Record<string, number> = { ArrowLeft: -1, ArrowRight: 1 };

export function setUpToolbar(): void {
  appendLateButtons();
  const [toolbar, more] = [element("toolbar"), element("show-more")];
  const isOpen = (): boolean => toolbar.classList.contains("is-open");
  const show = (isMore: boolean): void => {
    toolbar.classList.toggle("is-open", isMore);
    more.setAttribute("aria-expanded", String(isMore));
  };
  // A click on any other button closes the list of "More".
  toolbar.addEventListener("click", (event) => {
    if (event.target instanceof Element && event.target.closest("button")) show(event.target === more && !isOpen());
  });
  closesWithEscape("panel", isOpen, () => show(false));
  toolbar.addEventListener("keydown", (event) => {
    if (moveFocus(toolbar, STEPS[event.key] ?? 0)) event.preventDefault();
  });
}

/** Moves the focus to the next or the previous button of the toolbar, as arrow keys do in toolbars. */
function moveFocus(toolbar: HTMLElement, step: number): boolean {
  const buttons = [...toolbar.querySelectorAll("button")].filter((button) => button.checkVisibility() && !button.disabled);
  const ix = buttons.indexOf(document.activeElement as HTMLButtonElement);
  if (step === 0 || ix < 0) return false;
  buttons[(ix + step + buttons.length) % buttons.length]!.focus();
  return true;
}

/** Moves buttons that depend on the model or the robot behind all others, in the order in which they appear. */
function appendLateButtons(): void {
  const group = element("late-tools");
  const append = (button: HTMLElement): void => {
    if (!button.hidden && button !== group.lastElementChild) group.append(button);
  };
  const observer = new MutationObserver((changes) => {
    for (const { target } of changes) append(target as HTMLElement);
  });
  for (const button of document.querySelectorAll("#toolbar button[hidden]")) {
    observer.observe(button, { attributeFilter: ["hidden"] });
  }
}
