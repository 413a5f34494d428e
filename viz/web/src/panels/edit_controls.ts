// Erases parts of the model: the buttons of a panel, and the box that is erased.

import type { Connection } from "../connection/connection";
import type { CropBox } from "../view/crop_box";
import { element } from "./element";
import type { EditMessage, ErrorMessage, ModelStatus, Status } from "../connection/protocol";

/** Ids of edits begin here, so that they differ from those of pictures. */
const FIRST_ID = 2 ** 40;

export class EditControls {
  private readonly opener = element("toggle-edit", HTMLButtonElement);
  private readonly undo = element("undo-edit", HTMLButtonElement);
  private readonly note = element("edit-note");
  private nSent = 0;
  private shown: string | undefined;

  constructor(
    private readonly connection: Connection,
    private readonly box: CropBox,
    private readonly method: () => string | undefined,
  ) {}

  /** Whether the panel is open. */
  get isOpen(): boolean {
    return !element("edit").hidden;
  }

  /** Shows or hides the box. */
  opened(): void {
    this.box.isEditing = this.isOpen;
  }

  /** Erases the box. */
  eraseBox(): void {
    this.send({ action: "erase", box: this.box.corners }, "");
  }

  /** Erases small unconnected parts. */
  removeFloaters(): void {
    this.send({ action: "remove_floaters" }, "looking for floaters …");
  }

  /** Undoes the last edit. */
  undoLast(): void {
    this.send({ action: "undo" }, "");
  }

  /** Shows the edits of the model on the page. Returns whether the edits of any model have changed. */
  show(status: Status, model: ModelStatus): boolean {
    this.opener.hidden = !this.connection.supports("edit");
    const nEdits = model.edits ?? 0;
    this.undo.disabled = this.opener.disabled || nEdits === 0;
    this.undo.textContent = nEdits > 0 ? `Undo (${nEdits})` : "Undo";
    // The number does not change if an undo and another edit come between two messages.
    const shown = `${nEdits} ${status.edit_revision}`;
    if (shown === this.shown) return false;
    this.shown = shown;
    this.note.textContent = "";
    return true;
  }

  /** Shows why an edit failed. Returns false if the message is about something else. */
  failed(message: ErrorMessage): boolean {
    if (message.id === null || message.id < FIRST_ID) return false;
    this.note.textContent = message.message;
    return true;
  }

  private send(edit: Pick<EditMessage, "action" | "box">, note: string): void {
    // Keys reach this function even if the buttons are disabled.
    if (!this.isOpen || this.opener.disabled) return;
    this.nSent += 1;
    this.note.textContent = note;
    this.connection.send({ type: "edit", id: FIRST_ID + this.nSent, method: this.method(), ...edit });
  }
}
