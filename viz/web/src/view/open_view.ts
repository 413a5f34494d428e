// Opens the view, or shows why this is not possible.

import type { ServerClock } from "../connection/server_clock";
import type { Banner } from "../panels/banner";
import { element } from "../panels/element";
import { OrbitView } from "./orbit_view";

const NO_WEBGL =
  "WebGL 2 is not available in this browser: turn on hardware acceleration in its settings, or use a newer browser";
const LOST = "The WebGL context of this page was lost: if the scene does not return, reload the page";

export interface ViewEvents {
  clock: () => ServerClock;
  /** The view has changed. */
  moved: () => void;
  /** The browser has discarded what was drawn, or can draw again. */
  contextChanged: (isLost: boolean) => void;
}

export function openView(banner: Banner, { clock, moved, contextChanged }: ViewEvents): OrbitView {
  if (!document.createElement("canvas").getContext("webgl2")) {
    element("connection").textContent = "not connected";
    banner.setGraphics(NO_WEBGL);
    throw new Error(NO_WEBGL);
  }
  const canvas = element("canvas", HTMLCanvasElement);
  const view = new OrbitView(canvas, moved, clock);
  // Mobile browsers discard the WebGL context of background pages. These listeners must run after the renderer's.
  canvas.addEventListener("webglcontextlost", () => {
    banner.setGraphics(LOST);
    contextChanged(true);
  });
  canvas.addEventListener("webglcontextrestored", () => {
    banner.setGraphics("");
    view.contextRestored();
    contextChanged(false);
  });
  return view;
}
