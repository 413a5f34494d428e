// The dead-man switch of the page. It is held by one source at a time. Everything that ends a grip ends it permanently: the
// source must be released and pressed again. This file has no DOM.

/** What can hold the switch. */
export type Source = "gizmo" | "keys" | "pad" | "button" | "go" | "pad go";

/**
 * Sources whose state is read and not reported. If the page loses the focus, the release of all others may go to another
 * window, so that they count as released.
 */
const POLLED: readonly Source[] = ["pad", "pad go"];

export class DeadMan {
  /** How often the switch has been closed. */
  private nGrips = 0;
  private held: Source | null = null;
  /** Everything that is pressed, also if it does not hold the switch. */
  private readonly pressed = new Set<Source>();
  private isPermitted = false;
  private tickedAt: number | null = null;
  /** Why the last grip ended other than by its release; empty after a release. */
  reason = "";

  /** `changed` is called when the switch is closed and when it is opened. */
  constructor(private readonly changed: () => void) {}

  /** Number of the present grip; null while the switch is open. */
  get grip(): number | null {
    return this.held === null ? null : this.nGrips;
  }

  /** What holds the switch. */
  get source(): Source | null {
    return this.held;
  }

  /**
   * Sets whether a press closes the switch. Whatever is pressed when it becomes permitted must be pressed again. Returns
   * whether this has changed.
   */
  permit(isPermitted: boolean, reason: string): boolean {
    if (isPermitted === this.isPermitted) return false;
    this.isPermitted = isPermitted;
    if (!isPermitted) this.open(reason);
    return true;
  }

  /** Presses a source. Returns whether it holds the switch. With `mayGrip` false, it has no effect before its next press. */
  press(source: Source, mayGrip = true): boolean {
    if (this.pressed.has(source)) return this.held === source;
    this.pressed.add(source);
    if (!mayGrip || !this.isPermitted || this.held !== null) return false;
    this.held = source;
    this.nGrips += 1;
    this.reason = "";
    this.tickedAt = null;
    this.changed();
    return true;
  }

  release(source: Source): void {
    this.pressed.delete(source);
    if (this.held === source) this.end("");
  }

  /** Opens the switch. The source that held it stays without effect until it is released and pressed again. */
  open(reason: string): void {
    if (this.held !== null) this.end(reason);
  }

  /** Opens the switch because the page no longer receives events. */
  loseEvents(reason: string): void {
    this.open(reason);
    for (const source of this.pressed) if (!POLLED.includes(source)) this.pressed.delete(source);
  }

  /** Called for every sample. After a pause longer than the limit, the arm has braked, and the hand may have moved. */
  tick(nowMillis: number, maxGapMillis: number): void {
    const gap = this.tickedAt === null ? 0 : nowMillis - this.tickedAt;
    this.tickedAt = nowMillis;
    if (gap > maxGapMillis) this.open(`the page was busy for ${Math.round(gap)} ms`);
  }

  private end(reason: string): void {
    this.held = null;
    this.reason = reason;
    this.changed();
  }
}
