// The devices with which this page is used.

import { type Device, devicesOf, inTouchWords, isTouchDevice } from "./gestures";

let hasPressedKey = false;
window.addEventListener("keydown", () => (hasPressedKey = true), { capture: true, once: true });
let lastPointer: string | null = null;
window.addEventListener("pointerdown", ({ pointerType }) => (lastPointer = pointerType), { capture: true, passive: true });

/** Mouse, touch screen and keyboard, as far as the browser knows. */
export function devices(): Device[] {
  return devicesOf({
    hasFinePointer: matchMedia("(any-pointer: fine)").matches,
    hasCoarsePointer: matchMedia("(any-pointer: coarse)").matches,
    hasPressedKey,
  });
}

/** Whether the page is used with a finger. */
export function isTouched(): boolean {
  return isTouchDevice(lastPointer, matchMedia("(pointer: coarse)").matches, devices().includes("mouse"));
}

/** A text about mouse and keys in the words for the device in use. */
export function inDeviceWords(text: string): string {
  return isTouched() ? inTouchWords(text) : text;
}
