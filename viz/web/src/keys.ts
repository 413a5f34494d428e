// The table of all keys. Buttons, help and titles are made from it, and one listener finds the binding of a key.

import { announce } from "./panels/announcer";
import { element } from "./panels/element";
import { type Chord, type Focus, chordLabel, isPressed as isChordPressed, keepsKey, keyOf, parseChords } from "./key_chord";
import { isMovementKey } from "./view/movement_keys";

/** A button, its keys, and what they do. */
export interface KeyBinding {
  button: HTMLElement;
  chords: Chord[];
  /** Whether the keys have a meaning now. */
  when: () => boolean;
  act: () => void;
  /** Heading in the help: the label of the group of the button. */
  group: string;
  /** One sentence without keys. */
  help: string;
}

/** Something that Escape closes. */
interface Closable {
  isOpen: () => boolean;
  close: () => void;
}

const bindings: KeyBinding[] = [];
/** Kinds of things that Escape closes, the topmost first. */
const closables = { panel: [] as Closable[], mode: [] as Closable[] };
let onToggle = (): void => undefined;
let isFlying = false;

/** Listens to keys; `changed` is called after each toggle. */
export function setUpKeys(changed: () => void): void {
  onToggle = changed;
  window.addEventListener("keydown", press);
}

/** All bindings in the order of their registration. */
export function keyBindings(): readonly KeyBinding[] {
  return bindings;
}

/** Makes a button run a function, also by these keys (see `parseChords`), unless `when` is false or the button is disabled. */
export function action(id: string, keys: string, act: () => void, when: () => boolean = () => true): void {
  const button = element(id);
  button.addEventListener("click", act);
  const binding: KeyBinding = { button, chords: parseChords(keys), when, act, group: groupOf(button), help: "" };
  binding.help = withoutKeys(button.dataset.title ?? button.title, binding);
  button.ariaKeyShortcuts = keys.replaceAll("Ctrl", "Control");
  bindings.push(binding);
  button.title = titleOf(binding);
  button.dataset.title = button.title;
}

/** Makes a button switch something on and off. */
export function toggle(id: string, keys: string, apply: (isOn: boolean) => void): void {
  action(id, keys, () => {
    const isOn = !isPressed(id);
    element(id).setAttribute("aria-pressed", String(isOn));
    apply(isOn);
    onToggle();
  });
}

/** Whether the toggle with this id is on. */
export function isPressed(id: string): boolean {
  return element(id).getAttribute("aria-pressed") === "true";
}

/** Makes Escape close something: open panels first, the last registered one first, and then modes. */
export function closesWithEscape(kind: keyof typeof closables, isOpen: () => boolean, close: () => void): void {
  closables[kind].unshift({ isOpen, close });
}

/** Makes Escape switch these toggles off. */
export function endsWithEscape(...ids: string[]): void {
  for (const id of ids) closesWithEscape("mode", () => isPressed(id), () => element(id).click());
}

/** Says whether the user flies: then, the titles of buttons show no keys that move the eye. */
export function setFlying(flies: boolean): void {
  isFlying = flies;
  for (const binding of bindings.filter(({ chords }) => chords.some(({ key }) => isMovementKey(key)))) {
    const { button } = binding;
    button.dataset.title = titleOf(binding);
    if (isUsable(button) || button.hidden) button.title = button.dataset.title; // Otherwise, the title says why it is disabled.
  }
}

/** What is written on the keys of a binding, as alternatives. */
export function keysLabel({ chords }: KeyBinding): string {
  return chords.map(chordLabel).join(" or ");
}

/** Whether the focused control needs this key itself, as fields need the keys of text. */
export function isKeptByFocus(event: KeyboardEvent): boolean {
  return keepsKey(focusOf(event.target), keyOf(event));
}

function press(event: KeyboardEvent): void {
  if (event.defaultPrevented || event.repeat || isKeptByFocus(event)) return;
  const key = keyOf(event);
  // The browser closes modal dialogs, and keys have no effect on what they cover.
  const isCovered = document.querySelector("dialog:modal") !== null;
  const isDone = key === "escape" ? !isCovered && closeTopmost() : pressBound(event, isCovered);
  if (isDone) event.preventDefault();
}

function pressBound(event: KeyboardEvent, isCovered: boolean): boolean {
  const binding = bindings.find(
    ({ chords, when, button }) => chords.some((chord) => isChordPressed(chord, event)) && isUsable(button) && when(),
  );
  if (!binding || (isCovered && binding.button.getAttribute("aria-haspopup") !== "dialog")) return false;
  binding.act();
  const pressed = binding.button.ariaPressed;
  if (pressed !== null) announce(`${nameOf(binding.button)} ${pressed === "true" ? "on" : "off"}`);
  return true;
}

function closeTopmost(): boolean {
  const open = [...closables.panel, ...closables.mode].find(({ isOpen }) => isOpen());
  open?.close();
  return open !== undefined;
}

function isUsable(button: HTMLElement): boolean {
  return !button.hidden && !(button instanceof HTMLButtonElement && button.disabled);
}

/** The visible name of a button. */
export function nameOf(button: HTMLElement): string {
  return button.ariaLabel ?? button.textContent.trim();
}

function groupOf(button: HTMLElement): string {
  return button.parentElement?.closest("[aria-label]")?.ariaLabel ?? "Page";
}

function focusOf(target: EventTarget | null): Focus {
  if (!(target instanceof HTMLElement)) return { tag: "", type: "", isEditable: false };
  const type = target instanceof HTMLInputElement ? target.type : "";
  return { tag: target.tagName.toLowerCase(), type, isEditable: target.isContentEditable };
}

/** The title of a button, with the keys that have a meaning now. */
function titleOf(binding: KeyBinding): string {
  const { chords, help } = binding;
  const isShown = chords.length > 0 && !(isFlying && chords.some(({ key }) => isMovementKey(key)));
  return isShown ? `${help} (${keysLabel(binding)})`.trim() : help;
}

function withoutKeys(title: string, binding: KeyBinding): string {
  return title.replace(` (${keysLabel(binding)})`, "");
}
