// The list of keys, made from the titles of the buttons and the keys of the fly mode.

import { element } from "./element";

/** While flying, these keys have no other meaning. */
const FLY_KEYS = [
  ["W A S D", "Fly mode: forward, left, back, right. The arrow keys do the same"],
  ["Q E", "Fly mode: down and up"],
  ["Shift", "Fly mode: faster"],
] as const;

export function setUpHelp(): void {
  const dialog = element("help", HTMLDialogElement);
  const show = (): void => {
    const canEdit = !element("toggle-edit", HTMLButtonElement).hidden;
    const rows = [...document.querySelectorAll<HTMLButtonElement>(".toolbar button, .layers button, .edit button")].flatMap((button) => {
      const match = /^(.*?) \((.)\)(.*)$/.exec(button.title);
      const isAvailable = !button.hidden && (!button.closest(".edit") || canEdit);
      return match && isAvailable ? [row(match[2]!, match[1]! + match[3]!)] : [];
    });
    rows.push(...FLY_KEYS.map(([key, meaning]) => row(key, meaning)));
    element("keys").replaceChildren(...rows.flat());
    if (dialog.open) dialog.close();
    else dialog.showModal();
  };
  element("show-help").addEventListener("click", show);
  window.addEventListener("keydown", (event) => {
    if (event.key === "?") show();
  });
  dialog.addEventListener("click", () => dialog.close());
}

function row(key: string, meaning: string): HTMLElement[] {
  const term = document.createElement("dt");
  const details = document.createElement("dd");
  term.textContent = key;
  details.textContent = meaning;
  return [term, details];
}
