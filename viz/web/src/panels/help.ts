// The list of keys, made from the titles of the buttons and the keys of the fly mode.

import { element } from "./element";

/** While flying, these keys have no other meaning. */
const FLY_KEYS = [
  ["W A S D", "Fly mode: forward, left, back, right. The arrow keys do the same"],
  ["Q E", "Fly mode: down and up"],
  ["Shift", "Fly mode: faster"],
] as const;

/** A title with its key in parentheses. */
const KEY_IN_TITLE = /^(.*?) \((.)\)(.*)$/;

export function setUpHelp(): void {
  const dialog = element("help", HTMLDialogElement);
  const show = (): void => {
    const canEdit = !element("toggle-edit", HTMLButtonElement).hidden;
    const rows = buttons().flatMap((button) => {
      const match = KEY_IN_TITLE.exec(fullTitle(button));
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

/** Shows the keys in the titles of buttons again, or hides those that have another meaning while flying. */
export function showKeysInTitles(isShown: boolean): void {
  for (const button of buttons()) {
    const title = fullTitle(button);
    const [, before, key, after] = KEY_IN_TITLE.exec(title) ?? [];
    if (key === undefined || button.disabled) continue; // The title of a disabled button says why it is disabled.
    const isFlyKey = FLY_KEYS.some(([keys]) => keys.split(" ").includes(key));
    button.dataset.title = title;
    button.title = isShown || !isFlyKey ? title : before! + after!;
  }
}

function buttons(): HTMLButtonElement[] {
  return [...document.querySelectorAll<HTMLButtonElement>(".toolbar button, .layers button, .edit button")];
}

/** The original title, even while another one is shown. */
function fullTitle(button: HTMLButtonElement): string {
  return button.dataset.title ?? button.title;
}

function row(key: string, meaning: string): HTMLElement[] {
  const term = document.createElement("dt");
  const details = document.createElement("dd");
  term.textContent = key;
  details.textContent = meaning;
  return [term, details];
}
