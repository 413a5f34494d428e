// Titles of elements, and why a control is disabled.

/** Gives an element a title. While a control is disabled for a reason, its title is the reason instead. */
export function setTitle(target: HTMLElement, title: string): void {
  // A title that is set again would appear beside the tooltip with the same text.
  if (target.dataset.title === title) return;
  target.dataset.title = title;
  if (target.dataset.reason === undefined) target.title = title;
}

/** The title that an element has while it is not disabled for a reason. */
export function titleOf(target: HTMLElement): string {
  return target.dataset.title ?? target.title;
}

/** Disables a control and shows why, or enables it if there is no reason. */
export function disable(control: HTMLButtonElement, reason: string): void {
  setTitle(control, titleOf(control));
  control.disabled = reason !== "";
  if (reason === "") delete control.dataset.reason;
  else control.dataset.reason = reason;
  control.title = reason || titleOf(control);
}
