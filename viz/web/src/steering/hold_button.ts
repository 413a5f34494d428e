// Buttons that act while they are held, by a pointer or with Enter.

/**
 * Calls `changed` when the button is pressed and when it is released. It counts as released, too, when the pointer leaves it
 * and whenever the page may not see the release.
 */
export function holdButton(button: HTMLElement, changed: (isHeld: boolean) => void): void {
  let isHeld = false;
  /** The pointer that holds the button; null if Enter does. */
  let pointerId: number | null = null;
  const set = (held: boolean, pointer: number | null = null): void => {
    if (held === isHeld) return;
    isHeld = held;
    pointerId = pointer;
    button.classList.toggle("is-held", held);
    changed(held);
  };
  const capture = { capture: true };
  button.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    // A finger that slides off its first element would otherwise still belong to it.
    if (button.hasPointerCapture(event.pointerId)) button.releasePointerCapture(event.pointerId);
    set(true, event.pointerId);
  });
  for (const kind of ["pointerleave", "blur"] as const) button.addEventListener(kind, () => set(false));
  // The button may be hidden or covered before the release.
  for (const kind of ["pointerup", "pointercancel"] as const) {
    window.addEventListener(kind, (event) => event.pointerId === pointerId && set(false), capture);
  }
  // The release of one of several buttons of a mouse is a move.
  window.addEventListener("pointermove", (event) => event.pointerId === pointerId && (event.buttons & 1) === 0 && set(false), capture);
  button.addEventListener("keydown", (event) => {
    if (event.key !== "Enter") return;
    event.preventDefault();
    event.stopPropagation();
    if (!event.repeat && !event.metaKey) set(true);
  });
  // A hidden button does not receive the release.
  window.addEventListener("keyup", (event) => event.key === "Enter" && set(false), capture);
  // While Meta is down, macOS does not report the release of other keys.
  window.addEventListener("keydown", (event) => event.metaKey && set(false), capture);
  // A long press would open the menu of the browser, and then send no release.
  button.addEventListener("contextmenu", (event) => event.preventDefault());
  // Any other menu takes the keyboard.
  window.addEventListener("contextmenu", (event) => !event.defaultPrevented && set(false));
  window.addEventListener("blur", () => set(false));
  document.addEventListener("visibilitychange", () => document.hidden && set(false));
}
