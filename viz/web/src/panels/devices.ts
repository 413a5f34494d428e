// The devices with which this page is used.

import { type Device, devicesOf } from "./gestures";

let hasPressedKey = false;
window.addEventListener("keydown", () => (hasPressedKey = true), { capture: true, once: true });

/** Mouse, touch screen and keyboard, as far as the browser knows. */
export function devices(): Device[] {
  return devicesOf({
    hasFinePointer: matchMedia("(any-pointer: fine)").matches,
    hasCoarsePointer: matchMedia("(any-pointer: coarse)").matches,
    hasPressedKey,
  });
}
