// Small elements of panels.

/** An element with a text. */
export function child(tag: string, text = ""): HTMLElement {
  const made = document.createElement(tag);
  made.textContent = text;
  return made;
}

/** A list of names and values. */
export function descriptions(rows: readonly [string, string][]): HTMLElement {
  const list = document.createElement("dl");
  list.append(...rows.flatMap(([name, value]) => [child("dt", name), child("dd", value)]));
  return list;
}
