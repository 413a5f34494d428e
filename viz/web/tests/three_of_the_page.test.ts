import assert from "node:assert/strict";
import { readdirSync, readFileSync } from "node:fs";
import { test } from "node:test";

/** The folders of the scripts that are loaded later, relative to viz/web, where npm runs the tests. */
const FOLDERS = ["src/steering", "src/incidents", "src/headset"];
/** These belong to the page. */
const LOADER = "_loader.ts";

/** Names of three.js that a file uses as values. */
function used(source: string): string[] {
  const imports = [...source.matchAll(/import \{([^}]*)\} from "three"/g)].flatMap(([, names]) => names!.split(","));
  const values = imports.map((name) => name.trim()).filter((name) => !name.startsWith("type "));
  // Classes are constructed or compared, objects have members, and constants end like their kinds. Everything else is a type.
  const found = source.matchAll(
    /\bnew THREE\.(\w+)|\bTHREE\.(\w+)\.|instanceof THREE\.(\w+)|\bTHREE\.(\w+(?:Side|Filter|Format|Type))\b/g,
  );
  return [...values, ...[...found].map(([, made, member, compared, constant]) => (made ?? member ?? compared ?? constant)!)];
}

test("the page shares every class of three.js that the scripts loaded later use, and no other", () => {
  const files = FOLDERS.flatMap((folder) => readdirSync(folder).map((name) => `${folder}/${name}`));
  const own = files.filter((name) => !name.endsWith(LOADER));
  const wanted = new Set(own.flatMap((name) => used(readFileSync(name, "utf8"))));
  const shared = [...readFileSync("src/three_of_the_page.ts", "utf8").matchAll(/^ {2}(\w+): THREE\.\w+,$/gm)].map(([, name]) => name!);
  assert.ok(wanted.size > 5);
  assert.deepEqual([...wanted].sort(), shared.sort());
});
