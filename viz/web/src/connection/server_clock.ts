// Estimates the server's clock such that ages are never understated.

/** Maximum age of samples, because clocks drift. */
const MAX_SAMPLE_AGE_MILLIS = 30_000;

export class ServerClock {
  /** Send time of each ping, and the server's clock at its answer minus this send time. */
  private samples: { sentAt: number; ahead: number }[] = [];

  /**
   * Adds the answer to a ping. The server read its clock after the ping was sent, so the difference
   * is an upper bound.
   */
  observePong(sentAt: number, clockMillis: number): void {
    const oldest = performance.now() - MAX_SAMPLE_AGE_MILLIS;
    this.samples = this.samples.filter((sample) => sample.sentAt > oldest);
    this.samples.push({ sentAt, ahead: clockMillis - sentAt });
  }

  /**
   * Checks samples against the time in any message. The server read its clock before now, so the
   * difference is a lower bound.
   */
  observeMessage(clockMillis: number): void {
    const ahead = clockMillis - performance.now();
    // Samples below the lower bound were taken before one of the computers was suspended.
    this.samples = this.samples.filter((sample) => sample.ahead >= ahead);
  }

  /** Discards all samples, because a new server has a new clock. */
  forget(): void {
    this.samples = [];
  }

  /** Upper bound on the age of an event, milliseconds; null until the server has answered a ping. */
  age(clockMillis: number): number | null {
    const now = this.serverMillis(performance.now());
    return now === null ? null : now - clockMillis;
  }

  /** Upper bound on the server's clock at a time of this page; null until the server has answered a ping. */
  serverMillis(pageMillis: number): number | null {
    if (this.samples.length === 0) return null;
    return pageMillis + Math.min(...this.samples.map((sample) => sample.ahead));
  }
}
