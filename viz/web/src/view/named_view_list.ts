// Views that the user has named, as text for the storage of the browser.

import { decoded } from "./remembered";

export interface NamedView {
  name: string;
  /** The view, as in a link. */
  text: string;
}

export const MAX_NAME_LENGTH = 60;
/** Maximum number of views, because browsers store only a few megabytes for a page. */
export const MAX_NAMED_VIEWS = 100;

/** Reads a stored list. Leaves out entries that are damaged or have another format. */
export function namedViewsIn(stored: string | null): NamedView[] {
  let list: unknown;
  try {
    list = JSON.parse(stored ?? "[]");
  } catch {
    return [];
  }
  if (!Array.isArray(list)) return [];
  return list.filter(isNamedView).slice(0, MAX_NAMED_VIEWS).map(({ name, text }) => ({ name, text }));
}

/** The list with this view; a view of the same name is replaced. Null if the list is full or there is no name. */
export function withView(views: readonly NamedView[], view: NamedView): NamedView[] | null {
  const name = tidied(view.name);
  if (name === "") return null;
  const named = { name, text: view.text };
  const ix = views.findIndex((other) => other.name === name);
  if (ix >= 0) return views.map((other, at) => (at === ix ? named : other));
  return views.length < MAX_NAMED_VIEWS ? [...views, named] : null;
}

/** The list with another name for a view; null if the name is empty or in use. */
export function renamed(views: readonly NamedView[], from: string, to: string): NamedView[] | null {
  const name = tidied(to);
  const isTaken = views.some((view) => view.name === name && name !== from);
  return name === "" || isTaken ? null : views.map((view) => (view.name === from ? { ...view, name } : view));
}

/** A name that no view has. */
export function freeName(views: readonly NamedView[]): string {
  let n = views.length + 1;
  while (views.some(({ name }) => name === `View ${n}`)) n += 1;
  return `View ${n}`;
}

function tidied(name: string): string {
  return name.trim().slice(0, MAX_NAME_LENGTH);
}

function isNamedView(value: unknown): value is NamedView {
  const { name, text } = (value ?? {}) as Partial<Record<keyof NamedView, unknown>>;
  return typeof name === "string" && typeof text === "string" && tidied(name) === name && name !== "" && decoded(text) !== null;
}
