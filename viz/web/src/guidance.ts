// While images are taken for a calibration, the page enlarges them, and shows what to do next.

import type { Banner } from "./banner";
import type { LiveImages } from "./live_images";
import type { Guidance } from "./protocol";
import type { Subscriptions } from "./subscriptions";

export function showGuidance(
  guidance: Guidance | undefined,
  banner: Banner,
  subscriptions: Subscriptions,
  images: LiveImages,
): void {
  images.canDock = guidance === undefined; // The side panel is hidden.
  document.body.classList.toggle("guided", guidance !== undefined);
  banner.setGuidance(guidance ?? null);
  subscriptions.largeImages = guidance !== undefined;
}
