// The gestures of mouse and touch screen, for the help and for the hint at the first visit.

export type Device = "mouse" | "touch" | "keyboard";

export interface Gesture {
  how: string;
  what: string;
  /** Without these three, nobody can use the view. */
  isBasic?: true;
}

export const GESTURES: Record<"mouse" | "touch", Gesture[]> = {
  mouse: [
    { how: "Drag", what: "Orbit", isBasic: true },
    { how: "Drag with the right button", what: "Pan. Shift and the left button do the same", isBasic: true },
    { how: "Scroll", what: "Zoom", isBasic: true },
    { how: "Double click", what: "Orbit around this point of the model" },
    { how: "Click on an image", what: "Enlarge the image of a camera" },
    { how: "Rest on a button", what: "Show what it does" },
  ],
  touch: [
    { how: "Drag with one finger", what: "Orbit", isBasic: true },
    { how: "Drag with two fingers", what: "Pan", isBasic: true },
    { how: "Pinch", what: "Zoom", isBasic: true },
    { how: "Double tap", what: "Orbit around this point of the model" },
    { how: "Tap on an image", what: "Enlarge the image of a camera" },
    { how: "Touch and hold a button", what: "Show what it does" },
  ],
};

/**
 * Whether texts are about a finger: if the user last touched the page or, before the first press,
 * if fingers are the main pointers of the device.
 */
export function isTouchDevice(lastPointer: string | null, isMainPointerCoarse: boolean, hasMouse: boolean): boolean {
  return lastPointer === null ? isMainPointerCoarse || !hasMouse : lastPointer === "touch";
}

/** Answers to media queries, and what the user has done so far. */
export interface Signs {
  hasFinePointer: boolean;
  hasCoarsePointer: boolean;
  hasPressedKey: boolean;
}

/** The devices of the user. Mouse and keyboard are assumed unless there is only a touch screen. */
export function devicesOf({ hasFinePointer, hasCoarsePointer, hasPressedKey }: Signs): Device[] {
  const hasMouse = hasFinePointer || !hasCoarsePointer;
  return [
    ...(hasMouse ? (["mouse"] as const) : []),
    ...(hasCoarsePointer ? (["touch"] as const) : []),
    ...(hasMouse || hasPressedKey ? (["keyboard"] as const) : []),
  ];
}

/** A text for a finger instead of mouse and keys. Sentences about keys, and keys in parentheses at the end, are left out. */
export function inTouchWords(text: string): string {
  return text
    .replace(/ \([^()]*\)$/, "")
    .replace(/ ?\b(?:Esc|Delete) [a-z][^.]*\./g, "")
    .replace(/\bclick\b/g, "tap")
    .replace(/\bClick\b/g, "Tap");
}

/** The three gestures of a device in a few words: how and what. */
export function basicGestures(device: "mouse" | "touch"): [how: string, what: string][] {
  return GESTURES[device].filter(({ isBasic }) => isBasic).map(({ how, what }) => [how, what.split(".")[0]!.toLowerCase()]);
}
