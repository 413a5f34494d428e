// Small elements of panels.

/** An element with these properties. */
export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Partial<HTMLElementTagNameMap[K]> = {},
): HTMLElementTagNameMap[K] {
  return Object.assign(document.createElement(tag), properties);
}

/** An element with a text. */
export function child<K extends keyof HTMLElementTagNameMap>(tag: K, textContent = ""): HTMLElementTagNameMap[K] {
  return Object.assign(document.createElement(tag), { textContent });
}

/** A list of names and values. */
export function descriptions(rows: readonly [string, string][]): HTMLElement {
  const list = make("dl");
  list.append(...rows.flatMap(([name, value]) => [child("dt", name), child("dd", value)]));
  return list;
}

/**
 * Shows a text. An unchanged text is not set again, because screen readers would repeat it, and a
 * selection would be lost.
 */
export function setText(target: Element, text: string): void {
  if (target.textContent !== text) target.textContent = text;
}

const shownItems = new WeakMap<Element, string>();

/** Shows a list. The elements of an unchanged list are kept, because new ones would have to be laid out again. */
export function setList<T>(target: Element, items: readonly T[], elements: (item: T) => readonly HTMLElement[]): void {
  const key = JSON.stringify(items);
  if (shownItems.get(target) === key) return;
  shownItems.set(target, key);
  target.replaceChildren(...items.flatMap(elements));
}
