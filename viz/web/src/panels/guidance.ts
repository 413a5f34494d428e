// While images are taken for a calibration, the page enlarges them, and shows what to do next.

import type { Banner } from "./banner";
import type { Guidance } from "../connection/protocol";
import type { LiveImagesTopic } from "../topics/live_images";

export function showGuidance(guidance: Guidance | undefined, banner: Banner, images: LiveImagesTopic): void {
  document.body.classList.toggle("guided", guidance !== undefined);
  banner.setGuidance(guidance ?? null);
  images.large = guidance !== undefined;
}
