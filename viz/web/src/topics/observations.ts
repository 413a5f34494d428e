// When and how precisely each part of the scene was observed.

import { element } from "../panels/element";
import type { Quantity } from "../layers/observation_layer";
import type { OrbitView } from "../view/orbit_view";
import type { ObservationsHeader } from "../connection/protocol";
import { on, type Subscription, type Topic } from "./topic";

/** Maps have about 30 kB each. */
const HZ = 0.5;
/** Buttons that tint the model, and what the tint shows. */
export const TINTS: readonly { id: string; quantity: Quantity }[] = [
  { id: "toggle-age", quantity: "age" },
  { id: "toggle-uncertainty", quantity: "uncertainty" },
];

export class ObservationsTopic implements Topic {
  readonly name = "observations";
  readonly capability = "observations";
  readonly receivers = [
    on<ObservationsHeader>("observations", (header, payload) => {
      const failed = (error: unknown): void => console.error("cannot show the map of observations:", error);
      this.view.observations.receive(header, payload).catch(failed);
    }),
  ];
  private isShown = false;
  private isSearched = false;

  constructor(private readonly view: OrbitView, private readonly changed: () => void) {}

  /** What the tint of the model shows; null without a tint. */
  set tint(quantity: Quantity | null) {
    this.view.observations.show(quantity);
    this.isShown = quantity !== null;
    this.changed();
  }

  /** Whether the place that is seen worst is searched for. */
  set searched(isSearched: boolean) {
    this.isSearched = isSearched;
    this.changed();
  }

  subscriptions(isHidden: boolean): Subscription[] {
    return [{ rate_hz: (this.isShown || this.isSearched) && !isHidden ? HZ : 0 }];
  }

  restart(isSupported: boolean): void {
    this.view.observations.clear();
    for (const { id } of TINTS) element(id).hidden = !isSupported;
    element("toggle-coverage").hidden = !isSupported;
  }
}
