// Runs the unit tests of the page: bundles each file tests/*.test.ts, then runs the bundles with Node's test runner.
//
// usage: npm test [-- NAME]      NAME runs only the file tests/NAME.test.ts

import { build } from "esbuild";
import { spawnSync } from "node:child_process";
import { mkdirSync, readdirSync, rmSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
// In this folder, Node finds the libraries, which are not bundled.
const bundles = join(here, "node_modules/.tests");
rmSync(bundles, { recursive: true, force: true });
mkdirSync(bundles, { recursive: true });
const ending = `${process.argv[2] ?? ""}.test.ts`;
const isChosen = (name) => (process.argv[2] ? name === ending : name.endsWith(ending));
const names = readdirSync(join(here, "tests")).filter(isChosen);
if (names.length === 0) throw new Error(`the folder tests has no file ${process.argv[2] ? "" : "*"}${ending}`);
await build({
  entryPoints: names.map((name) => join(here, "tests", name)),
  outdir: bundles,
  outExtension: { ".js": ".mjs" },
  bundle: true,
  packages: "external",
  platform: "node",
  format: "esm",
  target: "es2022",
  sourcemap: "inline",
  logLevel: "warning",
});
const files = names.map((name) => join(bundles, name.replace(/\.ts$/, ".mjs")));
const { status } = spawnSync(process.execPath, ["--enable-source-maps", "--test", "--test-reporter=spec", ...files], {
  stdio: "inherit",
});
process.exit(status ?? 1);
