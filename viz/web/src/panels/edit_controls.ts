// Erases parts of the model: the buttons of a panel, their keys, and the box that is erased.

import type { Connection } from "../connection/connection";
import type { CropBox } from "../view/crop_box";
import { type EditState, editNews } from "./edit_news";
import { action } from "../keys";
import { element } from "./element";
import type { EditMessage, ErrorMessage, ModelStatus, Status } from "../connection/protocol";
import { showToast } from "./toast";

/** Ids of edits begin here, so that they differ from those of pictures. */
const FIRST_ID = 2 ** 40;

export class EditControls {
  /** Number of this client. */
  client = 0;
  private readonly opener = element("toggle-edit", HTMLButtonElement);
  private readonly undo = element("undo-edit", HTMLButtonElement);
  private readonly redo = element("redo-edit", HTMLButtonElement);
  private readonly note = element("edit-note");
  private nSent = 0;
  private shown: string | undefined;
  private before: EditState | null = null;

  constructor(
    private readonly connection: Connection,
    private readonly box: CropBox,
    private readonly method: () => string | undefined,
  ) {
    const isOpen = (): boolean => !element("edit").hidden;
    action("erase-box", () => this.send({ action: "erase", box: box.corners }, ""), isOpen);
    action("remove-floaters", () => this.send({ action: "remove_floaters" }, "looking for floaters …"), isOpen);
    action("undo-edit", () => this.send({ action: "undo" }, ""), isOpen);
    action("redo-edit", () => this.send({ action: "redo" }, ""), isOpen);
  }

  /** Shows or hides the box that is erased. */
  set isOpen(isOpen: boolean) {
    this.box.isEditing = isOpen;
  }

  /** Forgets the edits of the previous server. The present edits of another server are not announced as changes. */
  restart(): void {
    this.before = null;
  }

  /** Shows the edits of the model on the page. Returns whether the edits of any model have changed. */
  show(status: Status, model: ModelStatus): boolean {
    this.opener.hidden = !this.connection.supports("edit");
    const nEdits = model.edits ?? 0;
    const nUndone = model.undone_edits ?? 0;
    this.undo.disabled = this.opener.disabled || nEdits === 0;
    this.undo.textContent = nEdits > 0 ? `Undo (${nEdits})` : "Undo";
    this.redo.disabled = this.opener.disabled || nUndone === 0;
    this.redo.textContent = nUndone > 0 ? `Redo (${nUndone})` : "Redo";
    const hasNews = this.showNews(status);
    // The number does not change if an undo and another edit come between two messages.
    const shown = `${nEdits} ${status.edit_revision}`;
    if (shown === this.shown) return false;
    this.shown = shown;
    if (!hasNews) this.setNote("", false);
    return true;
  }

  /** Shows who has changed the edits, and where they were saved. Returns whether there is a new note. */
  private showNews(status: Status): boolean {
    const { edit_revision, last_edit, saved_edits } = status;
    const now: EditState = { edit_revision, last_edit, saved_edits };
    const { toast, note, hasFailed } = editNews(this.before, now, this.client);
    if (toast !== null) showToast(toast);
    if (note !== null) this.setNote(note, hasFailed);
    const isSaved = saved_edits?.revision !== this.before?.saved_edits?.revision;
    if (this.before && isSaved) this.setSaveNote(note ?? "", hasFailed);
    this.before = now;
    return note !== null;
  }

  /** Shows why an edit failed. Returns false if the message is about something else. */
  fail(message: ErrorMessage): boolean {
    if (message.id === null || message.id < FIRST_ID) return false;
    this.setNote(message.message, true);
    return true;
  }

  private setNote(text: string, hasFailed: boolean): void {
    this.note.textContent = text;
    this.note.classList.toggle("failed", hasFailed);
  }

  /** Shows the result of saving at the button in the side panel, too. */
  private setSaveNote(text: string, hasFailed: boolean): void {
    const note = element("save-note");
    note.textContent = text;
    note.hidden = text === "";
    note.classList.toggle("failed", hasFailed);
  }

  private send(edit: Pick<EditMessage, "action" | "box">, note: string): void {
    this.nSent += 1;
    this.setNote(note, false);
    this.connection.send({ type: "edit", id: FIRST_ID + this.nSent, method: this.method(), ...edit });
  }
}
