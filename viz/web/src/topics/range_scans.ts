// Scans of range scanners.

import { element } from "../panels/element";
import type { OrbitView } from "../view/orbit_view";
import type { RangeScanHeader } from "../connection/protocol";
import { on, type Subscription, type Topic } from "./topic";

/** Scans have 36 kB each. */
const HZ = 2;

export class RangeScansTopic implements Topic {
  readonly name = "range_scans";
  readonly capability = "range_scans";
  readonly receivers = [
    on<RangeScanHeader>("range_scan", (header, payload) => {
      this.view.scans.show(header, payload);
      element("toggle-scans").hidden = false;
      this.view.changed();
    }),
  ];
  private isShown = true;

  constructor(private readonly view: OrbitView, private readonly changed: () => void) {}

  /** Whether scans are shown. */
  set shown(shown: boolean) {
    this.view.scans.enabled = shown;
    this.isShown = shown;
    this.changed();
  }

  subscriptions(isHidden: boolean): Subscription[] {
    return [{ rate_hz: this.isShown && !isHidden ? HZ : 0 }];
  }

  restart(): void {
    this.view.scans.clear();
  }
}
