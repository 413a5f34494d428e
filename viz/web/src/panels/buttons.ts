// What the buttons of the view do. Their keys are in key_table.ts.

import { action, closesWithEscape, endsWithEscape, setFlying, toggle } from "../keys";
import type { KeyframePointsTopic } from "../topics/keyframe_points";
import type { KeyframesTopic } from "../topics/keyframes";
import type { LiveImagesTopic } from "../topics/live_images";
import { type ObservationsTopic, TINTS } from "../topics/observations";
import type { RangeScansTopic } from "../topics/range_scans";
import type { OrbitView } from "../view/orbit_view";
import type { ViewControls } from "../view/view_controls";
import type { CoverageHint } from "./coverage_hint";
import { element } from "./element";
import type { KeyframeBrowser } from "./keyframe_browser";
import type { LiveImages } from "./live_images";
import type { ShownModel } from "./shown_model";
import type { Skeleton } from "./skeleton";

/** What the buttons act on. */
export interface ButtonParts {
  view: OrbitView;
  viewControls: ViewControls;
  browser: KeyframeBrowser;
  coverage: CoverageHint;
  images: LiveImages;
  model: ShownModel;
  skeleton: Skeleton;
  keyframes: KeyframesTopic;
  liveImages: LiveImagesTopic;
  points: KeyframePointsTopic;
  scans: RangeScansTopic;
  observations: ObservationsTopic;
}

export function setUpButtons(parts: ButtonParts): void {
  setUpViewpoints(parts);
  setUpLayers(parts);
  setUpTools(parts);
  // Safari shows that a finger presses a button only if the page listens to touches.
  document.addEventListener("touchstart", () => undefined, { passive: true });
  action("full-screen", () => {
    if (document.fullscreenElement) void document.exitFullscreen();
    else void document.documentElement.requestFullscreen();
  });
}

function setUpViewpoints({ view, viewControls, browser }: ButtonParts): void {
  action("look-overview", () => view.showOverview());
  action("reset-view", () => view.reset());
  action("look-live", () => viewControls.rideNext());
  action("look-nearest", () => browser.toggle());
  action("look-top", () => view.lookAlong("top"));
  action("look-front", () => view.lookAlong("front"));
  toggle("toggle-fly", (isOn) => {
    view.flies = isOn;
    setFlying(isOn);
  });
}

function setUpLayers({ view, model, skeleton, keyframes, liveImages, points, scans, ...parts }: ButtonParts): void {
  toggle("toggle-model", (isOn) => {
    model.isVisible = isOn;
    skeleton.showsModel = isOn;
  });
  toggle("toggle-local", (isOn) => (model.isDrawnLocally = isOn));
  toggle("toggle-grid", (isOn) => (view.overlays.showsGround = isOn));
  toggle("toggle-keyframes", (isOn) => (keyframes.isLayerOn = isOn));
  toggle("toggle-points", (isOn) => (points.shown = isOn));
  toggle("toggle-scans", (isOn) => (scans.shown = isOn));
  toggle("toggle-robot", (isOn) => (view.robot.enabled = isOn));
  for (const { id, quantity } of TINTS) {
    toggle(id, (isOn) => {
      // At most one of them is on.
      for (const other of TINTS) if (other.id !== id) element(other.id).setAttribute("aria-pressed", "false");
      parts.observations.tint = isOn ? quantity : null;
    });
  }
  toggle("toggle-coverage", (isOn) => (parts.coverage.enabled = isOn));
  toggle("toggle-frames", (isOn) => (view.frames.enabled = isOn));
  toggle("toggle-images", (isOn) => (liveImages.shown = isOn));
  toggle("toggle-cut", (isOn) => (view.isCut = isOn));
  toggle("toggle-occlude", (isOn) => (view.occlusion.enabled = isOn));
}

function setUpTools({ view, images }: ButtonParts): void {
  toggle("toggle-crop", (isOn) => (view.crop.enabled = isOn));
  toggle("toggle-measure", (isOn) => (view.measure.enabled = isOn));
  toggle("toggle-follow", (isOn) => (view.follows = isOn));
  // The last one ends first.
  endsWithEscape("toggle-fly", "toggle-measure");
  closesWithEscape("mode", () => images.isEnlarged, () => images.reduce());
  closesWithEscape("mode", () => view.measure.hasBegun, () => view.measure.cancel());
}
