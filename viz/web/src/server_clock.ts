// The server's clock as seen from here. It errs on the late side, so that no age is understated.

/** A sample is used for this long: clocks drift apart. */
const SAMPLE_LIFE_MILLIS = 30_000;

export class ServerClock {
  /** When a ping was sent, and by how much the server's clock was ahead of that when it answered. */
  private samples: { sentAt: number; ahead: number }[] = [];

  /** Takes in the answer to a ping. The server read its clock after the ping was sent: it is at most that far ahead. */
  answered(sentAt: number, clockMillis: number): void {
    const oldest = performance.now() - SAMPLE_LIFE_MILLIS;
    this.samples = this.samples.filter((sample) => sample.sentAt > oldest);
    this.samples.push({ sentAt, ahead: clockMillis - sentAt });
  }

  /** Takes in the time of any message. The server read its clock before now: it is at least that far ahead. */
  heard(clockMillis: number): void {
    const ahead = clockMillis - performance.now();
    // Samples below were taken before one of the computers slept.
    this.samples = this.samples.filter((sample) => sample.ahead >= ahead);
  }

  /** A new server has a new clock. */
  forget(): void {
    this.samples = [];
  }

  /** How long ago something happened at most, milliseconds; null until the server has answered a ping. */
  age(clockMillis: number): number | null {
    if (this.samples.length === 0) return null;
    const ahead = Math.min(...this.samples.map((sample) => sample.ahead));
    return performance.now() + ahead - clockMillis;
  }
}
