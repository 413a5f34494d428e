// Estimates the server's clock such that ages are never understated.

/** Maximum age of samples, because clocks drift. */
const MAX_SAMPLE_AGE_MILLIS = 30_000;

/** Upper bound on the age of an event, milliseconds; null if it is not known. */
export type Age = () => number | null;

/** What is known about the clock of one server. */
interface Estimate {
  /** Send time of each ping, and the server's clock at its answer minus this send time. */
  samples: { sentAt: number; ahead: number }[];
}

export class ServerClock {
  private estimate: Estimate = { samples: [] };

  /**
   * Adds the answer to a ping. The server read its clock after the ping was sent, so the difference
   * is an upper bound.
   */
  observePong(sentAt: number, clockMillis: number): void {
    const oldest = performance.now() - MAX_SAMPLE_AGE_MILLIS;
    const { estimate } = this;
    estimate.samples = estimate.samples.filter((sample) => sample.sentAt > oldest);
    estimate.samples.push({ sentAt, ahead: clockMillis - sentAt });
  }

  /**
   * Checks samples against the time in any message. The server read its clock before now, so the
   * difference is a lower bound.
   */
  observeMessage(clockMillis: number): void {
    const ahead = clockMillis - performance.now();
    // Samples below the lower bound were taken before one of the computers was suspended.
    this.estimate.samples = this.estimate.samples.filter((sample) => sample.ahead >= ahead);
  }

  /** Discards all samples, because the page or the computer was suspended. */
  forget(): void {
    this.estimate.samples = [];
  }

  /** Begins anew, because a new server has a new clock. Ages of events of the old server stay known. */
  restart(): void {
    this.estimate = { samples: [] };
  }

  /** The age of an event of the present server, which stays valid after the connection has ended. */
  ageOf(clockMillis: number): Age {
    const { estimate } = this;
    return () => {
      const now = serverMillis(estimate, performance.now());
      return now === null ? null : now - clockMillis;
    };
  }

  /** Upper bound on the server's clock at a time of this page; null until the server has answered a ping. */
  serverMillis(pageMillis: number): number | null {
    return serverMillis(this.estimate, pageMillis);
  }
}

function serverMillis({ samples }: Estimate, pageMillis: number): number | null {
  if (samples.length === 0) return null;
  return pageMillis + Math.min(...samples.map((sample) => sample.ahead));
}
