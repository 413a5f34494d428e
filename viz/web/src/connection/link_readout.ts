// Shows the round-trip time and the received data rate.

import type { Connection } from "./connection";
import { element } from "../panels/element";
import { bytesText } from "../panels/quantities";

const PERIOD_MILLIS = 1000;

export class LinkReadout {
  private nBytes = 0;
  private at = performance.now();

  constructor(private readonly connection: Connection) {
    window.setInterval(() => this.show(), PERIOD_MILLIS);
  }

  private show(): void {
    const now = performance.now();
    const bytesPerSec = (1000 * (this.connection.nReceived - this.nBytes)) / (now - this.at);
    this.nBytes = this.connection.nReceived;
    this.at = now;
    const { roundTripMillis } = this.connection;
    const latency = roundTripMillis === null ? "–" : `${Math.max(1, Math.round(roundTripMillis))} ms`;
    element("link-text").textContent = this.connection.isOpen ? `${latency} · ${bytesText(bytesPerSec)}/s` : "";
  }
}
