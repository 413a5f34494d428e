import assert from "node:assert/strict";
import { readdirSync, readFileSync } from "node:fs";
import { test } from "node:test";

/** The folders of the script, relative to viz/web, where npm runs the tests. */
const FOLDER = "src/steering";
const FOLDERS = [FOLDER, "src/incidents"];
const LOADER = "steering_loader.ts";

/** Names of three.js that a file uses as values. */
function used(source: string): string[] {
  const imports = [...source.matchAll(/import \{([^}]*)\} from "three"/g)].flatMap(([, names]) => names!.split(","));
  const values = imports.map((name) => name.trim()).filter((name) => !name.startsWith("type "));
  // Classes are constructed, objects have members, and constants are numbers of sides. Everything else is a type.
  const found = source.matchAll(/\bnew THREE\.(\w+)|\bTHREE\.(\w+)\.|\bTHREE\.(\w+Side)\b/g);
  return [...values, ...[...found].map(([, made, member, side]) => (made ?? member ?? side)!)];
}

test("the page shares every class of three.js that the script for steering uses, and no other", () => {
  const files = FOLDERS.flatMap((folder) => readdirSync(folder).map((name) => `${folder}/${name}`));
  const own = files.filter((name) => !name.endsWith(LOADER));
  const wanted = new Set(own.flatMap((name) => used(readFileSync(name, "utf8"))));
  const shared = [...readFileSync(`${FOLDER}/${LOADER}`, "utf8").matchAll(/^ {2}(\w+): THREE\.\w+,$/gm)].map(([, name]) => name!);
  assert.ok(wanted.size > 5);
  assert.deepEqual([...wanted].sort(), shared.sort());
});
