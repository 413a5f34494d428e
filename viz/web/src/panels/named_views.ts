// The panel with saved views, and links to views.

import { element } from "./element";
import { make } from "./html";
import { store, stored } from "./storage";
import { freeName, MAX_NAMED_VIEWS, type NamedView, namedViewsIn, renamed, withView } from "../view/named_view_list";
import type { Status } from "../connection/protocol";
import type { ViewMemory } from "../view/view_memory";

const STORED_KEY = "named-views";
const LOCAL_HOSTS = ["localhost", "127.0.0.1", "[::1]"];

/**
 * Status with the identity to which views belong. This is the rig or, without a rig, the run or
 * model. Older servers do not send it.
 */
type Identified = Status & { identity?: { rig?: string | null; run?: string | null } | undefined };

export class NamedViews {
  private readonly input = element("view-name", HTMLInputElement);
  private readonly note = element("views-note");
  private key = STORED_KEY;
  private views: NamedView[] = [];

  constructor(private readonly memory: ViewMemory) {
    element("save-view").addEventListener("submit", (event) => {
      event.preventDefault();
      this.save();
    });
    element("copy-link").addEventListener("click", () => void this.copyLink());
    this.read();
    // This event means that another tab has changed the list.
    window.addEventListener("storage", (event) => {
      if (event.key === this.key) this.read();
    });
  }

  /** Shows the views of this rig or run. */
  runIs(status: Identified): void {
    const name = status.identity?.rig ?? status.identity?.run ?? "";
    const key = name === "" ? STORED_KEY : `${STORED_KEY} ${name}`;
    if (key === this.key) return;
    this.key = key;
    this.read();
  }

  private save(): void {
    const name = this.input.value || this.input.placeholder;
    const views = withView(this.views, { name, text: this.memory.viewText });
    if (!views) {
      this.note.textContent = `Not saved: there can be ${MAX_NAMED_VIEWS} views; delete one first`;
      return;
    }
    this.input.value = "";
    this.note.textContent = `Saved “${name.trim()}”`;
    this.change(views);
  }

  private async copyLink(): Promise<void> {
    const { link } = this.memory;
    const shown = element("view-link", HTMLInputElement);
    const isCopied = await copied(link);
    shown.hidden = isCopied;
    shown.value = link;
    if (!isCopied) shown.select();
    const where = LOCAL_HOSTS.includes(location.hostname)
      ? "The link works only on this computer, because the page is not shared"
      : "To open the link, others need access to this server";
    this.note.textContent = `${isCopied ? "Copied." : "Copy the link above."} ${where}`;
  }

  private read(): void {
    this.views = namedViewsIn(stored(this.key));
    this.list();
  }

  private change(views: NamedView[]): void {
    this.views = views;
    if (!store(this.key, JSON.stringify(views))) {
      this.note.textContent = "The browser stores nothing for this page: the views are lost when it is closed";
    }
    this.list();
  }

  private list(): void {
    this.input.placeholder = freeName(this.views);
    element("named-views").replaceChildren(...this.views.map((view) => this.row(view)));
  }

  private row(view: NamedView): HTMLLIElement {
    const row = make("li");
    const show = button(view.name, "Show this view", () => this.memory.show(view.text));
    show.className = "name";
    const rename = button("✎", `Rename “${view.name}”`, () => row.replaceChildren(this.nameEditor(view)));
    const remove = button("✕", `Delete “${view.name}”`, () => this.change(this.views.filter((other) => other !== view)));
    row.append(show, rename, remove);
    // The input must be in the document to be focused.
    rename.addEventListener("click", () => row.querySelector("input")?.select());
    return row;
  }

  /** An input in place of a row. Enter, or leaving the input, renames the view. Escape cancels. */
  private nameEditor(view: NamedView): HTMLInputElement {
    const { maxLength } = this.input;
    const input = make("input", { value: view.name, maxLength, ariaLabel: `New name of “${view.name}”` });
    input.addEventListener("keydown", (event) => {
      if (event.key === "Escape") input.value = view.name;
      if (event.key !== "Escape" && event.key !== "Enter") return;
      event.preventDefault(); // Escape does not close the panel, too.
      input.blur();
    });
    input.addEventListener("blur", () => {
      const views = renamed(this.views, view.name, input.value);
      this.note.textContent = views ? "" : `There is already a view “${input.value.trim()}”`;
      if (views) this.change(views);
      else this.list();
    });
    return input;
  }
}

function button(text: string, title: string, act: () => void): HTMLButtonElement {
  const made = make("button", { textContent: text, title });
  if (text.length === 1) made.ariaLabel = title;
  made.addEventListener("click", act);
  return made;
}

/** Copies a text. Returns false if the browser does not allow it, for example on a page without TLS. */
async function copied(text: string): Promise<boolean> {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    return false;
  }
}
