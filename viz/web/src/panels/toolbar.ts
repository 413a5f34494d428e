// The toolbar. Buttons that appear late are behind all others, so that these keep their places. On phones, "More" shows the
// buttons that do not fit in the bar.

import { closesWithEscape } from "../keys";
import { element } from "./element";

/** Buttons that depend on the model or the robot, in their order, which is that in which they usually appear. */
const LATE_BUTTONS = ["toggle-edit", "toggle-steer", "toggle-incidents", "toggle-follow", "toggle-history"];
const STEPS: Record<string, number> = { ArrowLeft: -1, ArrowRight: 1 };

export function setUpToolbar(): void {
  moveLateButtons();
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

/** Moves the late buttons behind all others. While they are hidden, they take no space. */
function moveLateButtons(): void {
  element("late-tools").append(...LATE_BUTTONS.map((id) => element(id)));
}
