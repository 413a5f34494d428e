// Texts about edits that have changed since the last status.

import type { LastEdit, SavedEdits } from "../connection/protocol";
import { capitalized } from "./sentence";

/** The part of a status that is about edits of any model. */
export interface EditState {
  edit_revision: number;
  last_edit?: LastEdit | undefined;
  saved_edits?: SavedEdits | undefined;
}

export interface EditNews {
  /** A message about an edit of another client. */
  toast: string | null;
  /** A note on the edit of this client, or on the result of saving; null to keep the present note. */
  note: string | null;
  hasFailed: boolean;
}

/** Texts about the changes between two statuses. `before` is null for the first status, which is not announced. */
export function editNews(before: EditState | null, now: EditState, client: number): EditNews {
  const news: EditNews = { toast: null, note: null, hasFailed: false };
  if (!before) return news;
  if (now.edit_revision !== before.edit_revision) {
    const edit = now.last_edit;
    const isOwn = edit?.client === client;
    news.note = edit && isOwn ? capitalized(edit.text) : "";
    if (edit && !isOwn) news.toast = `client ${edit.client} ${edit.text}`;
  }
  const saved = now.saved_edits;
  if (saved && saved.revision !== before.saved_edits?.revision) {
    news.note = capitalized(saved.text);
    news.hasFailed = saved.has_failed;
  }
  return news;
}
