// The help: gestures and keys in groups, for the devices of this user only.

import { action, keyBindings, keysLabel } from "../keys";
import { devices, isTouched } from "./devices";
import { element } from "./element";
import { GESTURES } from "./gestures";
import { child, make } from "./html";

interface Group {
  title: string;
  rows: [how: string, what: string][];
}

/** Keys that belong to no button. */
const VIEW_KEYS: Group = {
  title: "Keys: view, after a click on it",
  rows: [
    ["← → ↑ ↓", "Orbit"],
    ["Shift + ← → ↑ ↓", "Pan"],
    ["+ −", "Zoom"],
  ],
};
const FLY_KEYS: Group = {
  title: "Keys: while flying",
  rows: [
    ["W A S D", "Forward, left, back, right. The arrow keys do the same"],
    ["Q E", "Down and up"],
    ["Shift", "Faster"],
  ],
};
const STEER_KEYS: Group = {
  title: "Keys: jogging, while control is yours and Keys is on",
  rows: [
    ["W A S D", "Hand forward, left, back, right, in the chosen axes, while held"],
    ["Q E", "Hand down and up"],
    ["← → ↑ ↓", "Turn left and right, nose up and down"],
    ["Z C", "Roll left and right"],
    ["1 2", "Move the arm, or the base under it"],
  ],
};
const STEER_PAD: Group = {
  title: "Gamepad: while control is yours",
  rows: [
    ["Hold a trigger", "Dead-man switch: without it, nothing moves"],
    ["Left stick, D-pad", "Hand left, right, forward, back; up and down"],
    ["Right stick, shoulders", "Turn and nose up and down; roll"],
    ["Trigger and lower button", "Go to the ghost, while held"],
    ["Right button", "Stop the robot"],
    ["Upper button", "Switch between arm and base, while no trigger is held"],
  ],
};
const CLOSE_KEYS: Group = {
  title: "Keys: everywhere",
  rows: [["Esc", "Close the topmost panel, or end flying and measuring"]],
};

export function setUpHelp(): void {
  const dialog = element("help", HTMLDialogElement);
  const filter = element("help-filter", HTMLInputElement);
  action("show-help", () => {
    if (dialog.open) {
      dialog.close();
      return;
    }
    element("keys").replaceChildren(...groups().map(section));
    filter.value = "";
    search("");
    dialog.showModal();
    element("close-help").focus(); // Not the field: on phones, a keyboard would open.
  });
  filter.addEventListener("input", () => search(filter.value));
  element("close-help").addEventListener("click", () => dialog.close());
  // In a search field with a text, browsers only clear the text.
  dialog.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    event.preventDefault();
    dialog.close();
  });
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog && isOutside(dialog, event)) dialog.close();
  });
}

function groups(): Group[] {
  const present = devices();
  const pointers: ("mouse" | "touch")[] = isTouched() ? ["touch", "mouse"] : ["mouse", "touch"];
  const gestures = pointers
    .filter((device) => present.includes(device))
    .map((device) => ({
      title: device === "mouse" ? "Mouse" : "Touch screen",
      rows: GESTURES[device].map(({ how, what }): [string, string] => [how, what]),
    }));
  const isSteered = !element("toggle-steer").hidden;
  const steering = isSteered ? [STEER_KEYS, STEER_PAD] : [];
  if (!present.includes("keyboard")) return isSteered ? [...gestures, STEER_PAD] : gestures;
  return [...gestures, VIEW_KEYS, ...boundKeys(), FLY_KEYS, ...steering, CLOSE_KEYS];
}

/** The keys of all buttons that exist now, in the groups of the buttons. */
function boundKeys(): Group[] {
  const found = new Map<string, Group>();
  for (const binding of keyBindings()) {
    const { button, chords, group, help } = binding;
    if (chords.length === 0 || button.hidden || isPartOfHidden(button)) continue;
    const entry = found.get(group) ?? { title: `Keys: ${group.charAt(0).toLowerCase()}${group.slice(1)}`, rows: [] };
    entry.rows.push([keysLabel(binding), help]);
    found.set(group, entry);
  }
  return [...found.values()];
}

/** Whether a button is in a panel that cannot be opened, because its own button is hidden. */
function isPartOfHidden(button: HTMLElement): boolean {
  const panel = button.closest(".panel");
  const opener = panel && document.querySelector<HTMLElement>(`[aria-controls="${panel.id}"]`);
  return opener?.hidden === true;
}

function section({ title, rows }: Group): HTMLElement {
  const made = make("section");
  const list = make("dl");
  list.append(...rows.map(row));
  made.append(child("h3", title), list);
  return made;
}

function row([how, what]: [string, string]): HTMLElement {
  const made = make("div");
  made.append(child("dt", how), child("dd", what));
  return made;
}

/** Shows only entries with this text. */
function search(text: string): void {
  const wanted = text.trim().toLowerCase();
  let nShown = 0;
  for (const group of document.querySelectorAll<HTMLElement>("#keys section")) {
    const rows = [...group.querySelectorAll<HTMLElement>("dl > div")];
    for (const row of rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
    const n = rows.filter((row) => !row.hidden).length;
    group.hidden = n === 0;
    nShown += n;
  }
  element("help-empty").textContent = nShown === 0 ? `No entry contains "${text.trim()}".` : "";
}

function isOutside(dialog: HTMLElement, { clientX, clientY }: MouseEvent): boolean {
  const { left, right, top, bottom } = dialog.getBoundingClientRect();
  return clientX < left || clientX > right || clientY < top || clientY > bottom;
}
