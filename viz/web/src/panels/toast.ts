// A short message over the view that disappears.

import { element } from "./element";

const SHOWN_MILLIS = 6000;
let hiding: ReturnType<typeof setTimeout> | undefined;

/** Shows a message for some seconds. It replaces the previous one. */
export function showToast(text: string): void {
  const toast = element("toast");
  toast.textContent = text;
  toast.hidden = false;
  clearTimeout(hiding);
  hiding = setTimeout(() => (toast.hidden = true), SHOWN_MILLIS);
}
