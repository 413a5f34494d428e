// What keys do. Titles and the help show the keys of buttons, and one listener finds the binding of a key.

import { announce } from "./panels/announcer";
import { element } from "./panels/element";
import { type Chord, type Focus, chordLabel, isPressed as isChordPressed, isTextField, keepsKey, keyOf, parseChords } from "./key_chord";
import { KEYS } from "./key_table";
import { setTitle, titleOf } from "./panels/title";
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
  /** If it has the focus, Escape closes it before the others. */
  root?: HTMLElement | undefined;
}

const bindings: KeyBinding[] = [];
/**
 * Kinds of elements that Escape closes, in this order. Within a kind, the last registered element
 * is closed first. Cards come last, because they hide little.
 */
const closables: Record<"panel" | "mode" | "card", Closable[]> = { panel: [], mode: [], card: [] };
let onToggle = (): void => undefined;
let isFlying = false;

/** Listens to keys; `changed` is called after each toggle. */
export function setUpKeys(changed: () => void): void {
  onToggle = changed;
  window.addEventListener("keydown", press);
}

/** All bindings, in the order of the table. */
export function keyBindings(): readonly KeyBinding[] {
  const order = Object.keys(KEYS);
  return [...bindings].sort((a, b) => order.indexOf(a.button.id) - order.indexOf(b.button.id));
}

/** Makes a button run a function, also by its keys in key_table.ts, unless `when` is false or the button is disabled. */
export function action(id: string, act: () => void, when: () => boolean = () => true): void {
  const button = element(id);
  const keys = KEYS[id] ?? "";
  button.addEventListener("click", act);
  const binding: KeyBinding = { button, chords: parseChords(keys), when, act, group: groupOf(button), help: "" };
  binding.help = titleOf(button);
  button.ariaKeyShortcuts = keys.replaceAll("Ctrl", "Control");
  bindings.push(binding);
  setTitle(button, titleWithKeys(binding));
}

/** Makes a button switch something on and off. Its keys work while `when` is true. */
export function toggle(id: string, apply: (isOn: boolean) => void, when: () => boolean = () => true): void {
  const switchOver = (): void => {
    const isOn = !isPressed(id);
    element(id).setAttribute("aria-pressed", String(isOn));
    apply(isOn);
    onToggle();
  };
  action(id, switchOver, when);
}

/** Whether the toggle with this id is on. */
export function isPressed(id: string): boolean {
  return element(id).getAttribute("aria-pressed") === "true";
}

/** Makes Escape close something. */
export function closesWithEscape(
  kind: keyof typeof closables,
  isOpen: () => boolean,
  close: () => void,
  root?: HTMLElement,
): void {
  closables[kind].unshift({ isOpen, close, root });
}

/** Makes Escape switch these toggles off. */
export function endsWithEscape(...ids: string[]): void {
  for (const id of ids) closesWithEscape("mode", () => isPressed(id), () => element(id).click());
}

/** Says whether the user flies: then, the titles of buttons show no keys that move the eye. */
export function setFlying(flies: boolean): void {
  isFlying = flies;
  for (const binding of bindings.filter(({ chords }) => chords.some(({ key }) => isMovementKey(key)))) {
    setTitle(binding.button, titleWithKeys(binding));
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

/** Whether the focused control takes all keys as text. */
export function isTyping(event: KeyboardEvent): boolean {
  return isTextField(focusOf(event.target));
}

/** Whether a modal dialog covers the page. Keys have no effect on elements that it covers. */
export function isPageCovered(): boolean {
  return document.querySelector("dialog:modal") !== null;
}

function press(event: KeyboardEvent): void {
  if (event.defaultPrevented || event.repeat || isKeptByFocus(event)) return;
  const key = keyOf(event);
  const isCovered = isPageCovered();
  // The browser closes modal dialogs.
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
  const open = [...closables.panel, ...closables.mode, ...closables.card].filter(({ isOpen }) => isOpen());
  const closed = open.find(({ root }) => root?.contains(document.activeElement)) ?? open[0];
  closed?.close();
  return closed !== undefined;
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
function titleWithKeys(binding: KeyBinding): string {
  const { chords, help } = binding;
  const isShown = chords.length > 0 && !(isFlying && chords.some(({ key }) => isMovementKey(key)));
  return isShown ? `${help} (${keysLabel(binding)})`.trim() : help;
}
