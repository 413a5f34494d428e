// Round trips to the server: their duration decides whether the arm follows the hand, and the fastest ones give the
// server's clock. This file has no DOM.

/** Number of round trips of which the median counts: it ignores single late ones. */
const N_MEDIAN = 5;
/** The arm follows the hand again below this share of the threshold, and after this time. */
const RETURN_SHARE = 0.7;
const RETURN_MILLIS = 3000;
/** Maximum age of round trips for the clock, because clocks drift. */
const MAX_AGE_MILLIS = 30_000;
/** Pings without answers are forgotten after this time. */
const LOST_MILLIS = 10_000;

export type Mode = "servo" | "preview";

interface Sample {
  sentMillis: number;
  roundTripMillis: number;
  /** The server's clock minus the page's at the middle of the round trip. */
  aheadMillis: number;
}

export class RoundTrips {
  private nextId = 1;
  private readonly sent = new Map<number, number>();
  private samples: Sample[] = [];

  /** The id of a new ping. */
  ping(nowMillis: number): number {
    const id = this.nextId++;
    this.sent.set(id, nowMillis);
    return id;
  }

  pong(id: number, timeMicros: number, nowMillis: number): void {
    const sentMillis = this.sent.get(id);
    if (sentMillis === undefined) return;
    // Messages arrive in order, so that earlier pings have no answer any more.
    for (const earlier of this.sent.keys()) if (earlier <= id) this.sent.delete(earlier);
    const roundTripMillis = nowMillis - sentMillis;
    const aheadMillis = timeMicros / 1000 - 0.5 * (sentMillis + nowMillis);
    this.samples = this.samples.filter((sample) => nowMillis - sample.sentMillis < MAX_AGE_MILLIS);
    this.samples.push({ sentMillis, roundTripMillis, aheadMillis });
  }

  /** Begins anew with another connection. */
  restart(): void {
    this.sent.clear();
    this.samples = [];
  }

  /** The present round-trip time: the median of the last ones, or the age of a ping without answer; null if it is unknown. */
  millis(nowMillis: number): number | null {
    const last = this.samples.slice(-N_MEDIAN).map(({ roundTripMillis }) => roundTripMillis);
    for (const [id, sentMillis] of this.sent) if (nowMillis - sentMillis > LOST_MILLIS) this.sent.delete(id);
    if (last.length < 3) return null;
    const waiting = Math.max(0, ...[...this.sent.values()].map((sentMillis) => nowMillis - sentMillis));
    return Math.max(median(last), waiting);
  }

  /** The server's clock at a time of the page, microseconds; null if it is unknown. Its error is half of the fastest round trip. */
  serverMicros(pageMillis: number): number | null {
    if (this.samples.length === 0) return null;
    const best = this.samples.reduce((a, b) => (b.roundTripMillis < a.roundTripMillis ? b : a));
    return Math.round(1000 * (pageMillis + best.aheadMillis));
  }
}

/** Chooses by the round-trip time whether the arm follows the hand, with hysteresis. */
export class ModeChoice {
  private chosen: Mode = "preview";
  private isFirst = true;
  /** Since when the round-trip time has been short enough to follow the hand again. */
  private shortSince: number | null = null;

  /** The mode at this round-trip time; null while it is unknown. */
  update(roundTripMillis: number | null, thresholdMillis: number, nowMillis: number): Mode {
    if (roundTripMillis === null) {
      this.restart();
    } else if (this.isFirst) {
      this.isFirst = false;
      this.chosen = roundTripMillis <= thresholdMillis ? "servo" : "preview";
    } else if (!(roundTripMillis <= thresholdMillis)) {
      this.chosen = "preview"; // NaN, too.
      this.shortSince = null;
    } else if (roundTripMillis > RETURN_SHARE * thresholdMillis) {
      this.shortSince = null;
    } else {
      this.shortSince ??= nowMillis;
      if (nowMillis - this.shortSince >= RETURN_MILLIS) this.chosen = "servo";
    }
    return this.chosen;
  }

  private restart(): void {
    this.chosen = "preview";
    this.isFirst = true;
    this.shortSince = null;
  }
}

/** The middle of some numbers. */
export function median(values: readonly number[]): number {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)] ?? Number.NaN;
}
