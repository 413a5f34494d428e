import assert from "node:assert/strict";
import { readFileSync, writeFileSync } from "node:fs";
import { test } from "node:test";
import page from "../src/index.html" with { type: "text" };
import { chordLabel, parseChords } from "../src/key_chord";
import { KEYS } from "../src/key_table";

/** The guide, relative to viz/web, where npm runs the tests. */
const GUIDE = "../../docs/guide/page-keys.md";
const HEAD = "| Key | Button | What it does |\n|---|---|---|\n";

/** The row of a button: its keys, its label and its title. */
function row(id: string): string {
  const found = page.match(new RegExp(`<button id="${id}"([^>]*)>([^<]*)`));
  assert.ok(found, `the page has no button ${id}`);
  const [, attributes, text] = found;
  const label = attributes!.match(/aria-label="([^"]*)"/)?.[1] ?? text!.trim();
  const title = attributes!.match(/ title="([^"]*)"/)?.[1];
  assert.ok(label && title, `the button ${id} has no label or title`);
  const keys = parseChords(KEYS[id]!).map((chord) => `\`${chordLabel(chord)}\``);
  return `| ${keys.join(", ")} | ${label} | ${title} |\n`;
}

test("the table of keys in the guide is that of the page", () => {
  const guide = readFileSync(GUIDE, "utf8");
  const start = guide.indexOf(HEAD);
  assert.ok(start >= 0, `${GUIDE} has no table of keys`);
  const end = guide.indexOf("\n\n", start) + 1;
  const table = HEAD + Object.keys(KEYS).map(row).join("");
  if (process.env["FIELDRIG_WRITE_DOCS"]) {
    writeFileSync(GUIDE, guide.slice(0, start) + table + guide.slice(end));
    return;
  }
  assert.equal(guide.slice(start, end), table, "run `make docs`");
});
