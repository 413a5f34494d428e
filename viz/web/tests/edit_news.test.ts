import assert from "node:assert/strict";
import { test } from "node:test";
import { editNews } from "../src/panels/edit_news";

const NOTHING = { toast: null, note: null, hasFailed: false };
const ERASED = { client: 3, text: "erased a box" };

test("the first status is no news", () => {
  const saved_edits = { revision: 2, text: "edits saved in runs/a", has_failed: false };
  assert.deepEqual(editNews(null, { edit_revision: 5, last_edit: ERASED, saved_edits }, 1), NOTHING);
});

test("edits of other clients are named, those of this client are confirmed", () => {
  const before = { edit_revision: 0 };
  const now = { edit_revision: 1, last_edit: ERASED };
  assert.deepEqual(editNews(before, now, 1), { toast: "client 3 erased a box", note: "", hasFailed: false });
  assert.deepEqual(editNews(before, now, 3), { toast: null, note: "Erased a box", hasFailed: false });
  assert.deepEqual(editNews(now, { ...now }, 1), NOTHING);
});

test("older servers do not name the client", () => {
  assert.deepEqual(editNews({ edit_revision: 0 }, { edit_revision: 1 }, 1), { ...NOTHING, note: "" });
});

test("results of saving are shown once, with failures", () => {
  const failed = { revision: 1, text: "cannot save the edits: disk full", has_failed: true };
  const now = { edit_revision: 0, saved_edits: failed };
  assert.deepEqual(editNews({ edit_revision: 0 }, now, 1), {
    toast: null,
    note: "Cannot save the edits: disk full",
    hasFailed: true,
  });
  assert.deepEqual(editNews(now, now, 1), NOTHING);
  const again = { edit_revision: 0, saved_edits: { ...failed, revision: 2 } };
  assert.ok(editNews(now, again, 1).hasFailed, "the same failure again");
});
