// Bundles the page into dist/: one HTML, one stylesheet, one script at the start, and scripts and workers for what only some
// runs need. Nothing is loaded from elsewhere.

import { build } from "esbuild";
import { copyFileSync, mkdirSync, utimesSync } from "node:fs";
import { basename, dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
mkdirSync(join(here, "dist"), { recursive: true });
const options = {
  outdir: join(here, "dist"),
  bundle: true,
  minify: true,
  target: "es2022",
  legalComments: "eof",
  logLevel: "info",
};
/** `import()` loads a script of its own, which has the name of the module. */
const ownScripts = {
  name: "own scripts",
  setup({ onResolve }) {
    onResolve({ filter: /^\./ }, ({ kind, path }) =>
      kind === "dynamic-import" ? { path: `./${basename(path)}.js`, external: true } : undefined,
    );
  },
};
/** The part of three.js that draws nothing. */
const withoutRenderer = {
  name: "without renderer",
  setup({ onResolve }) {
    onResolve({ filter: /^three$/ }, () => ({ path: join(here, "node_modules/three/build/three.core.js") }));
  },
};
/** The classes of three.js that the page has, for a script that draws with them: see src/three_of_the_page.ts. */
const threeOfThePage = {
  name: "three of the page",
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^three$/ }, ({ path }) => ({ path, namespace: "page" }));
    onLoad({ filter: /^/, namespace: "page" }, () => ({ contents: "module.exports = globalThis.fieldrigThree" }));
  },
};
await build({
  ...options,
  entryPoints: {
    app: join(here, "src/main.ts"),
    splat_worker: join(here, "src/layers/splat_worker.ts"),
    video_worker: join(here, "src/view/video_worker.ts"),
  },
  format: "iife",
  plugins: [ownScripts],
});
await build({
  ...options,
  entryPoints: {
    mesh_loaders: join(here, "src/layers/mesh_loaders.ts"),
    coverage: join(here, "src/panels/coverage.ts"),
    study_page: join(here, "src/study/study_page.ts"),
    workspace_page: join(here, "src/workspace/workspace_page.ts"),
  },
  format: "esm",
  plugins: [withoutRenderer],
});
await build({
  ...options,
  entryPoints: { steering: join(here, "src/steering/steering.ts"), headset: join(here, "src/headset/headset.ts") },
  format: "esm",
  plugins: [threeOfThePage],
});
await build({ entryPoints: [join(here, "src/app.css")], outfile: join(here, "dist/app.css"), bundle: true, minify: true });
copyFileSync(join(here, "src/index.html"), join(here, "dist/index.html"));
// Cargo looks for the bundle again when the build script is younger than its last build.
const now = new Date();
utimesSync(join(here, "../build.rs"), now, now);
