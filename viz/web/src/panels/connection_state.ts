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
  /** What is wrong although the connection is open; empty if nothing is. */
  problem: () => string;
}

const PERIOD_MILLIS = 500;

export class ConnectionState {
  private readonly shown = element("connection");

  private text = "connecting";

  constructor(private readonly sources: ConnectionSources) {
    window.setInterval(() => this.showText(), PERIOD_MILLIS);
  }

  receive(state: State, text: string): void {
    const before = this.shown.dataset.state;
    const wasOpen = before === "open" || before === "silent";
    const hasEnded = state === "lost" && this.sources.hasEnded();
    this.shown.dataset.state = hasEnded ? "ended" : state;
    this.text = hasEnded ? "the server has stopped" : text;
    this.showText();
    this.sources.show({ state, text, hasEnded });
    if (state === "open" && !wasOpen) this.sources.restart();
    if (this.shown.dataset.state !== before) this.sources.changed();
  }

  private showText(): void {
    const problem = this.shown.dataset.state === "open" ? this.sources.problem() : "";
    this.shown.classList.toggle("slow", problem !== "");
    setText(this.shown, problem === "" ? this.text : `connected, ${problem}`);
  }
}
