// The focus of the keyboard when something closes.

/** Closes a panel. If the focus is in the panel, the element that has opened it gets it back. */
export function closePanel(panel: HTMLElement, opener: HTMLElement, close: () => void): void {
  const hadFocus = panel.contains(document.activeElement);
  close();
  if (hadFocus) opener.focus({ preventScroll: true });
}
