// The measured points of the keyframes.

import { element } from "../panels/element";
import type { OrbitView } from "../view/orbit_view";
import type { KeyframePointsHeader } from "../connection/protocol";
import { on, type Subscription, type Topic } from "./topic";

/** Keyframes whose points are sent per second, 22 kB each. */
const HZ = 20;

export class KeyframePointsTopic implements Topic {
  readonly name = "keyframe_points";
  readonly capability = "keyframe_points";
  readonly receivers = [
    on<KeyframePointsHeader>("keyframe_points", (header, payload) => {
      this.view.points.add(header, payload);
      this.view.changed();
    }),
  ];
  private isShown = false;

  constructor(private readonly view: OrbitView, private readonly changed: () => void) {}

  /** Whether points are shown. */
  set shown(shown: boolean) {
    this.view.points.enabled = shown;
    this.isShown = shown;
    this.changed();
  }

  subscriptions(isHidden: boolean): Subscription[] {
    return [{ rate_hz: this.isShown && !isHidden ? HZ : 0 }];
  }

  restart(isSupported: boolean): void {
    this.view.points.clear();
    element("toggle-points").hidden = !isSupported;
  }
}
