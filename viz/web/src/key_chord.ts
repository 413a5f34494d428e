// Names of keys with modifiers: parses them, compares them with events, and decides which keys a focused control keeps.

/** One key with its modifiers. */
export interface Chord {
  /** `KeyboardEvent.key` in lower case. */
  key: string;
  /** Control, or Command on a Mac. */
  hasControl: boolean;
  hasShift: boolean;
}

/** The part of a keyboard event that identifies a chord. */
export interface Press {
  key: string;
  code: string;
  ctrlKey: boolean;
  metaKey: boolean;
  altKey: boolean;
  shiftKey: boolean;
}

/** The element that has the focus, as far as it matters to keys. */
export interface Focus {
  tag: string;
  /** Type of an `input`; otherwise empty. */
  type: string;
  isEditable: boolean;
}

/** Keys whose name differs from the text on the key. */
const LABELS: Record<string, string> = {
  arrowleft: "←",
  arrowright: "→",
  arrowup: "↑",
  arrowdown: "↓",
  escape: "Esc",
  " ": "Space",
};
/** Inputs without text. */
const NOT_TEXT = ["range", "checkbox", "radio", "button", "color", "file", "submit", "reset"];
const VALUE_KEYS = ["arrowleft", "arrowright", "arrowup", "arrowdown", "home", "end", "pageup", "pagedown"];

/** Parses chords separated by spaces, such as `0 Home`, `Ctrl+Shift+Z` or `Space`. */
export function parseChords(text: string): Chord[] {
  return text.split(" ").filter(Boolean).map(parseChord);
}

function parseChord(text: string): Chord {
  const names = text.toLowerCase().split("+");
  const isPlus = text.endsWith("+"); // The key "+" itself: "+" or "Ctrl++".
  const last = names[names.length - 1]!;
  const key = isPlus ? "+" : last === "space" ? " " : last;
  return { key, hasControl: names.includes("ctrl"), hasShift: names.includes("shift") };
}

/** What is written on the keys of a chord. */
export function chordLabel({ key, hasControl, hasShift }: Chord): string {
  const name = LABELS[key] ?? key.charAt(0).toUpperCase() + key.slice(1);
  return [...(hasControl ? ["Ctrl"] : []), ...(hasShift ? ["Shift"] : []), name].join("+");
}

/** Whether an event is this chord. */
export function isPressed({ key, hasControl, hasShift }: Chord, press: Press): boolean {
  if (press.altKey || hasControl !== (press.ctrlKey || press.metaKey)) return false;
  // Without Control, Shift chooses between characters ("?"), and can be held while flying.
  const ignoresShift = !hasControl && !hasShift && key.length === 1;
  return (ignoresShift || hasShift === press.shiftKey) && key === keyOf(press);
}

/**
 * The key in lower case. On keyboards without Latin letters, this is the letter at the same
 * position of an English keyboard.
 */
export function keyOf({ key, code }: Pick<Press, "key" | "code">): string {
  const isLatin = key.length !== 1 || key.charCodeAt(0) < 0x250;
  return (isLatin ? key : (/^(?:Key|Digit)(.)$/.exec(code)?.[1] ?? key)).toLowerCase();
}

/**
 * Whether the focused element needs this key. Fields need the keys of text. Sliders and lists need
 * only the keys that change their value. No element needs Escape, which always closes something.
 */
export function keepsKey({ tag, type, isEditable }: Focus, key: string): boolean {
  if (key === "escape") return false;
  if (isTextField({ tag, type, isEditable })) return true;
  if (key === " " || key === "enter") return ["input", "select", "button", "summary", "a"].includes(tag);
  const hasValue = tag === "select" || (tag === "input" && (type === "range" || type === "radio"));
  return hasValue && VALUE_KEYS.includes(key);
}

/** Whether keys enter text in the focused element. */
export function isTextField({ tag, type, isEditable }: Focus): boolean {
  return isEditable || tag === "textarea" || (tag === "input" && !NOT_TEXT.includes(type));
}
