// Shows the state of the connection, and notices when a new one is open.

import type { ConnectionState as State } from "../connection/connection";
import { element } from "./element";
import { setText } from "./html";

/** A state of the connection. `hasEnded` is set if the program has ended as expected. */
export interface ConnectionNews {
  state: State;
  text: string;
  hasEnded: boolean;
}

export interface ConnectionSources {
  /** Whether the server has said that it stops, after everything that was expected from it. */
  hasEnded: () => boolean;
  show: (news: ConnectionNews) => void;
  /** A new connection is open: the server may be another one. */
  restart: () => void;
  /** The state has changed. */
  changed: () => void;
}

export class ConnectionState {
  private readonly shown = element("connection");

  constructor(private readonly sources: ConnectionSources) {}

  receive(state: State, text: string): void {
    const before = this.shown.dataset.state;
    const wasOpen = before === "open" || before === "silent";
    const hasEnded = state === "lost" && this.sources.hasEnded();
    this.shown.dataset.state = hasEnded ? "ended" : state;
    setText(this.shown, hasEnded ? "the server has stopped" : text);
    this.sources.show({ state, text, hasEnded });
    if (state === "open" && !wasOpen) this.sources.restart();
    if (this.shown.dataset.state !== before) this.sources.changed();
  }
}
