// Bundles the page into dist/: one HTML, one script, two workers, one stylesheet, nothing loaded from elsewhere.

import { build } from "esbuild";
import { copyFileSync, mkdirSync, utimesSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
mkdirSync(join(here, "dist"), { recursive: true });
await build({
  entryPoints: {
    app: join(here, "src/main.ts"),
    splat_worker: join(here, "src/layers/splat_worker.ts"),
    video_worker: join(here, "src/view/video_worker.ts"),
  },
  outdir: join(here, "dist"),
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  legalComments: "eof",
  logLevel: "info",
});
await build({ entryPoints: [join(here, "src/app.css")], outfile: join(here, "dist/app.css"), bundle: true, minify: true });
copyFileSync(join(here, "src/index.html"), join(here, "dist/index.html"));
// Cargo looks for the bundle again when the build script is younger than its last build.
const now = new Date();
utimesSync(join(here, "../build.rs"), now, now);
