// Whether data flow on an open connection. Heartbeats also arrive from a server that is too busy to
// send pictures, and over a link on which pictures wait for minutes.

/** A connection is slow if something has been awaited for longer than this. */
export const SLOW_MILLIS = 5000;
/** Data that devices cause all the time. Scans are not expected, because none are sent while they are hidden. */
const EXPECTED = ["live_image", "robot_state"];

export class Flow {
  /** Whether the run reads devices now. */
  isReading = false;
  /** When live data arrived last; null if none are expected. Hidden pages receive none. */
  private liveAt: number | null = null;

  /** Called for every message. */
  received(type: string): void {
    if (EXPECTED.includes(type) || (type === "range_scan" && this.liveAt !== null)) this.liveAt = performance.now();
  }

  /** Expects no data until the next ones arrive, because the connection is new or the page is hidden. */
  restart(): void {
    this.liveAt = null;
  }

  /** What is wrong with the open connection; empty if nothing is. `pictureMillis`: how long a picture has been awaited. */
  problem(pictureMillis: number | null): string {
    const now = performance.now();
    if (document.hidden) this.restart();
    if ((pictureMillis ?? 0) > SLOW_MILLIS) return "slow";
    return this.isReading && now - (this.liveAt ?? now) > SLOW_MILLIS ? "no live data" : "";
  }
}
