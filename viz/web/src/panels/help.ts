// The list of keys, made from the table of keys.

import { action, keyBindings, keysLabel } from "../keys";
import { element } from "./element";

const FLY_KEYS = [
  ["W A S D", "Fly mode: forward, left, back, right. The arrow keys do the same"],
  ["Q E", "Fly mode: down and up"],
  ["Shift", "Fly mode: faster"],
] as const;

export function setUpHelp(): void {
  const dialog = element("help", HTMLDialogElement);
  action("show-help", "?", () => {
    const rows = keyBindings()
      .filter(({ button, chords }) => chords.length > 0 && !button.hidden)
      .map((binding) => row(keysLabel(binding), binding.help));
    rows.push(...FLY_KEYS.map(([key, meaning]) => row(key, meaning)));
    element("keys").replaceChildren(...rows.flat());
    if (dialog.open) dialog.close();
    else dialog.showModal();
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
