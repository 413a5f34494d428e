// Chunks of the model that the page draws itself.

import type { OrbitView } from "../view/orbit_view";
import type { ModelChunkHeader, ModelChunksRemoved } from "../connection/protocol";
import { on, type Subscription, type Topic } from "./topic";

/** Versions of the model per second. */
const HZ = 1;

export class ModelChunksTopic implements Topic {
  readonly name = "model_chunks";
  readonly capability = "model_chunks";
  readonly receivers = [
    on<ModelChunkHeader>("model_chunk", (header, payload) => this.view.local.receive(header, payload)),
    on<ModelChunksRemoved>("model_chunks_removed", (message) => this.view.local.removed(message)),
  ];
  private drawn: string | null = null;

  constructor(private readonly view: OrbitView, private readonly changed: () => void) {
    // A page that becomes visible subscribes again, and receives all chunks again.
    document.addEventListener("visibilitychange", () => {
      if (!document.hidden) view.local.renew();
    });
  }

  /** The model that the page draws; null if the server draws it. */
  set method(method: string | null) {
    this.view.local.method = method;
    this.drawn = method;
    this.changed();
  }

  subscriptions(isHidden: boolean): Subscription[] {
    return [this.drawn && !isHidden ? { rate_hz: HZ, method: this.drawn } : { rate_hz: 0 }];
  }

  restart(): void {
    this.view.local.renew();
  }
}
