// Buttons that act while they are held, by a pointer or with Enter.

/** Calls `changed` when the button is pressed and when it is released. Leaving the button releases it, too. */
export function holdButton(button: HTMLElement, changed: (isHeld: boolean) => void): void {
  let isHeld = false;
  let pointerId: number | null = null;
  const set = (held: boolean): void => {
    if (held === isHeld) return;
    isHeld = held;
    button.classList.toggle("is-held", held);
    changed(held);
  };
  button.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    pointerId = event.pointerId;
    // A finger that slides off its first element would otherwise still belong to it.
    if (button.hasPointerCapture(event.pointerId)) button.releasePointerCapture(event.pointerId);
    set(true);
  });
  for (const kind of ["pointerleave", "blur"] as const) button.addEventListener(kind, () => set(false));
  // The button may be hidden or covered before the release.
  for (const kind of ["pointerup", "pointercancel"] as const) {
    window.addEventListener(kind, (event) => event.pointerId === pointerId && set(false), { capture: true });
  }
  button.addEventListener("keydown", (event) => {
    if (event.key !== "Enter") return;
    event.preventDefault();
    event.stopPropagation();
    if (!event.repeat) set(true);
  });
  button.addEventListener("keyup", (event) => event.key === "Enter" && set(false));
  // A long press would open the menu of the browser, and then send no release.
  button.addEventListener("contextmenu", (event) => event.preventDefault());
  window.addEventListener("blur", () => set(false));
  document.addEventListener("visibilitychange", () => document.hidden && set(false));
}
