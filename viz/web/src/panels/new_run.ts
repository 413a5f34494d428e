// Notices that the server shows another run than before, for example after the program was started again.

import type { Status } from "../connection/protocol";

export class NewRun {
  private run: string | null = null;

  /** `begin` is called with a sentence when another run has begun. */
  constructor(private readonly begin: (sentence: string) => void) {}

  show({ identity, source }: Pick<Status, "identity" | "source">): void {
    const run = identity?.run ?? null;
    const before = this.run;
    if (run === null || run === before) return;
    this.run = run;
    if (before) this.begin(`${source ? "Another model" : "A new run has started"}: ${run}`);
  }
}
