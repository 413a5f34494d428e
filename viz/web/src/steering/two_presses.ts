// Two deliberate presses of a button, for actions that a double click must not trigger. This file has no DOM.

/** A second press that comes earlier is a double click, or a finger that trembles. */
const MIN_MILLIS = 400;
/** The second press counts only within this time after the first. */
const MAX_MILLIS = 5000;

export class TwoPresses {
  /** The first press, and what was asked for. */
  private first: { subject: number; millis: number } | null = null;

  /** `nowMillis` reads a clock that does not go back. */
  constructor(private readonly nowMillis: () => number) {}

  /** Whether a second press is awaited for this subject. */
  isAwaited(subject: number | null): boolean {
    return this.since(subject) !== null;
  }

  /**
   * A press. Returns whether it is the second one of two for the same subject. Each press that comes too early begins the wait
   * anew, so that quick presses never count, however many there are.
   */
  press(subject: number): boolean {
    const sinceMillis = this.since(subject);
    if (sinceMillis !== null && sinceMillis >= MIN_MILLIS) {
      this.first = null;
      return true;
    }
    this.first = { subject, millis: this.nowMillis() };
    return false;
  }

  /** Time since the first press; null if there was none for this subject, or too long ago. */
  private since(subject: number | null): number | null {
    if (this.first === null || this.first.subject !== subject) return null;
    const millis = this.nowMillis() - this.first.millis;
    return millis <= MAX_MILLIS ? millis : null;
  }
}
