// The time from the hand to the joints: how old the input was when its setpoint was given to the arm. This file has no DOM.

import type { SteerState } from "./messages";
import { median } from "./round_trip";

/** Number of commands of the median, and the age from which they are not shown. */
const N_TIMES = 15;
const OLD_MICROS = 2_000_000;

export class HandTimes {
  private times: number[] = [];
  private newestSequence = -1;
  private appliedMicros = -Infinity;

  /** `device` is the number of this page. */
  constructor(private readonly device: number) {}

  add({ applied }: SteerState): void {
    if (!applied || applied.device !== this.device || applied.sequence <= this.newestSequence) return;
    this.newestSequence = applied.sequence;
    this.appliedMicros = applied.applied_micros;
    this.times = [...this.times, (applied.applied_micros - applied.captured_micros) / 1000].slice(-N_TIMES);
  }

  /** Median of the last commands, milliseconds; null if there are none, or if they are old. */
  millis({ time_micros }: SteerState): number | null {
    const isOld = time_micros - this.appliedMicros > OLD_MICROS;
    return isOld || this.times.length === 0 ? null : median(this.times);
  }
}
