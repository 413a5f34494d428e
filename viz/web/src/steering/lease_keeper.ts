// Keeps control of the arm while somebody uses the page, and gives it back otherwise. This file has no DOM.

/** Period of messages while no samples are sent. */
const RENEW_MILLIS = 1000;
/** Control is given back after this time without input, and after this time in a hidden tab. */
const IDLE_MILLIS = 5 * 60_000;
const HIDDEN_MILLIS = 30_000;

/** What to send for the lease: samples renew it, too. */
export type Keeping = "sample" | "renew" | "release" | "nothing";

export class LeaseKeeper {
  isHidden = false;
  private hiddenMillis = 0;
  private usedMillis = 0;
  private sentMillis = -Infinity;

  /** The operator uses the page, or has just taken control. */
  used(nowMillis: number): void {
    this.usedMillis = nowMillis;
  }

  setHidden(isHidden: boolean, nowMillis: number): void {
    this.isHidden = isHidden;
    this.hiddenMillis = nowMillis;
  }

  /** Why control should be given back; empty if it should be kept. */
  reason(nowMillis: number): string {
    if (this.isHidden && nowMillis - this.hiddenMillis > HIDDEN_MILLIS) return "the page was hidden";
    return nowMillis - this.usedMillis > IDLE_MILLIS ? "the page was not used" : "";
  }

  /** What to send now. */
  keep(nowMillis: number): Keeping {
    const ends = this.reason(nowMillis) !== "";
    if (!ends && !this.isHidden) return "sample";
    if (nowMillis - this.sentMillis < RENEW_MILLIS) return "nothing";
    this.sentMillis = nowMillis;
    return ends ? "release" : "renew";
  }
}
