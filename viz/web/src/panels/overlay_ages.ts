// Fades live cameras and range scans that have become old, and shows the age of the scans.

import type { ServerClock } from "../connection/server_clock";
import { FRESH_MILLIS } from "../layers/freshness";
import type { OrbitView } from "../view/orbit_view";
import { element } from "./element";
import { ageText } from "./quantities";

const PERIOD_MILLIS = 100;

export class OverlayAges {
  /** Whether the input has ended, so that old data are expected. */
  hasEnded = false;

  constructor(
    private readonly view: OrbitView,
    private readonly clock: () => ServerClock,
  ) {
    window.setInterval(() => this.show(), PERIOD_MILLIS);
  }

  private show(): void {
    const ageMillis = (capturedMillis: number): number => this.clock().ageOf(capturedMillis)() ?? Infinity;
    const haveCamerasChanged = this.view.overlays.showAges(ageMillis);
    const haveScansChanged = this.view.scans.showAges(ageMillis);
    if (haveCamerasChanged || haveScansChanged) this.view.changed();
    const label = element("scan-age");
    const oldest = this.view.scans.oldest(ageMillis);
    label.hidden = oldest === null || oldest.ageMillis <= FRESH_MILLIS || this.hasEnded;
    if (oldest && !label.hidden) label.textContent = `${oldest.scanner} ${ageText(oldest.ageMillis)}`;
  }
}
