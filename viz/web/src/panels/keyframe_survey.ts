// Measures the error of all keyframes in small pictures, one after the other, so that they can be sorted by it.

import type { NumberedKeyframe } from "../connection/protocol";
import type { KeyframeComparer } from "./keyframe_comparison";
import { keyframeKey } from "./keyframe_order";

/** Part of the time that the server may spend on these pictures. */
const MAX_TIME_FRAC = 0.25;
const MIN_PAUSE_MILLIS = 50;
/** Pause after a failure, for example because the connection was lost. */
const RETRY_MILLIS = 1000;
/** A keyframe that has failed this often counts as one that cannot be measured. */
const MAX_FAILURES = 3;

export class KeyframeSurvey {
  /** PSNR of the measured keyframes, dB; infinite for those that cannot be measured. */
  readonly psnrOf = new Map<string, number>();
  private isRunning = false;
  private isWanted = false;

  constructor(
    private readonly comparer: Pick<KeyframeComparer, "compare">,
    private readonly keyframes: () => readonly NumberedKeyframe[],
    private readonly changed: () => void,
  ) {}

  /** Continues until all keyframes are measured, or stops after the present one. */
  set enabled(isEnabled: boolean) {
    this.isWanted = isEnabled;
    if (isEnabled && !this.isRunning) void this.run();
  }

  /** Number of measured keyframes that still exist. */
  get nMeasured(): number {
    return this.keyframes().filter((keyframe) => this.psnrOf.has(keyframeKey(keyframe))).length;
  }

  /** Measures everything again, for example for another model. */
  forget(): void {
    this.psnrOf.clear();
    this.changed();
  }

  private async run(): Promise<void> {
    this.isRunning = true;
    let nFailures = 0;
    for (let next = this.next(); next; next = this.next()) {
      const began = performance.now();
      const { errors, render } = await this.comparer.compare(next);
      const hasFailed = typeof render === "string";
      nFailures = hasFailed ? nFailures + 1 : 0;
      if (hasFailed && nFailures < MAX_FAILURES) {
        await pause(RETRY_MILLIS);
        continue;
      }
      nFailures = 0;
      this.psnrOf.set(keyframeKey(next), errors?.psnr ?? Infinity);
      this.changed();
      await pause(Math.max(MIN_PAUSE_MILLIS, (performance.now() - began) * (1 / MAX_TIME_FRAC - 1)));
    }
    this.isRunning = false;
  }

  private next(): NumberedKeyframe | undefined {
    if (!this.isWanted) return undefined;
    return this.keyframes().find((keyframe) => !this.psnrOf.has(keyframeKey(keyframe)));
  }
}

function pause(millis: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, millis));
}
