// The focus of the keyboard: where it goes when something closes, and when it is shown.

/**
 * Marks buttons that got the focus by a click. The next key, which usually belongs to another
 * button, would otherwise show the ring of the focus, and the ring would look like a state.
 */
export function markClickedButtons(): void {
  document.addEventListener("focusin", ({ target }) => {
    if (target instanceof Element) target.toggleAttribute("data-clicked", !target.matches(":focus-visible"));
  });
  // A button that has the focus already does not get it again by a click.
  document.addEventListener("pointerdown", ({ target }) => {
    if (target instanceof Element) target.closest("button")?.setAttribute("data-clicked", "");
  });
}

/** Closes a panel. If the focus is in the panel, the element that has opened it gets it back. */
export function closePanel(panel: HTMLElement, opener: HTMLElement, close: () => void): void {
  const hadFocus = panel.contains(document.activeElement);
  close();
  if (hadFocus) opener.focus({ preventScroll: true });
}
