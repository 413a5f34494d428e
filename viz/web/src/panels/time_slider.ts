// Goes back in time: shows only the keyframes, and their points, up to a moment of the run, and the photograph of that
// moment.
//
// The slider moves from keyframe to keyframe and not along the clock, because the times of a resumed run have a gap.

import { element } from "./element";
import { byTime, nearestInTime } from "./keyframe_times";
import { stopwatchText } from "./quantities";
import type { KeyframesTopic } from "../topics/keyframes";
import type { NumberedKeyframe } from "../connection/protocol";
import type { OrbitView } from "../view/orbit_view";
import type { TimePhoto } from "./time_photo";

export class TimeSlider {
  private readonly panel = element("history");
  private readonly slider = element("history-time", HTMLInputElement);
  private readonly text = element("history-text");
  /** The keyframes, the oldest first. */
  private ordered: NumberedKeyframe[] = [];
  /**
   * Time of the oldest keyframe that the page has received. The store of the run may have dropped
   * this keyframe since.
   */
  private firstNanos = Infinity;
  /** The chosen time on the clock of the rig; null while the present is shown. */
  private chosenNanos: number | null = null;

  constructor(
    private readonly keyframes: KeyframesTopic,
    view: OrbitView,
    private readonly photo: TimePhoto,
  ) {
    keyframes.onChange.push(() => this.listChanged());
    this.slider.addEventListener("input", () => this.choose(this.slider.valueAsNumber));
    element("history-before").addEventListener("click", () => this.choose(this.slider.valueAsNumber - 1));
    element("history-after").addEventListener("click", () => this.choose(this.slider.valueAsNumber + 1));
    element("history-now").addEventListener("click", () => this.choose(this.ordered.length - 1));
    element("history-look").addEventListener("click", () => {
      const chosen = this.ordered[this.slider.valueAsNumber];
      if (chosen) view.lookFromKeyframe(chosen);
    });
  }

  private get isOpen(): boolean {
    return !this.panel.hidden;
  }

  /**
   * Called when the panel was opened or closed. In both cases, the present is shown. Otherwise, old
   * keyframes could be taken for all keyframes.
   */
  opened(isOpen: boolean): void {
    this.chosenNanos = null;
    this.keyframes.isBrowsed = isOpen;
    this.keyframes.showUntil(null);
    if (isOpen) this.showSlider();
    else this.photo.show(null);
  }

  private listChanged(): void {
    const before = new Set(this.ordered.map((keyframe) => keyframe.stamp_nanos));
    this.ordered = byTime(this.keyframes.list.keyframes);
    if (!this.ordered.some((keyframe) => before.has(keyframe.stamp_nanos))) this.forget();
    this.firstNanos = Math.min(this.firstNanos, this.ordered[0]?.stamp_nanos ?? Infinity);
    element("toggle-history").hidden = this.ordered.length < 2;
    if (this.isOpen) this.showSlider();
  }

  /** Returns to the present, because the keyframes are the first ones or belong to another run. */
  private forget(): void {
    this.firstNanos = Infinity;
    if (this.chosenNanos !== null) this.keyframes.showUntil(null);
    this.chosenNanos = null;
  }

  /** Chooses a keyframe. The last one stands for the present, so that new keyframes are shown again. */
  private choose(ix: number): void {
    const chosen = this.ordered[Math.min(Math.max(0, ix), this.ordered.length - 1)];
    if (!chosen) return;
    this.chosenNanos = ix >= this.ordered.length - 1 ? null : chosen.stamp_nanos;
    this.keyframes.showUntil(this.chosenNanos);
    this.showSlider();
  }

  private showSlider(): void {
    const { ordered, chosenNanos } = this;
    const last = ordered.length - 1;
    const ix = chosenNanos === null ? last : nearestInTime(ordered, chosenNanos);
    this.slider.max = String(Math.max(0, last));
    this.slider.value = String(Math.max(0, ix));
    const chosen = ordered[ix];
    const text = chosen ? this.textOf(chosen, ix) : "no keyframes";
    this.text.textContent = text;
    this.slider.setAttribute("aria-valuetext", text);
    element("history-now", HTMLButtonElement).disabled = chosenNanos === null;
    element("history-before", HTMLButtonElement).disabled = ix <= 0;
    element("history-after", HTMLButtonElement).disabled = chosenNanos === null;
    element("history-look", HTMLButtonElement).disabled = !chosen;
    this.photo.show(chosen ?? null);
  }

  private textOf(chosen: NumberedKeyframe, ix: number): string {
    const newestNanos = this.ordered[this.ordered.length - 1]!.stamp_nanos;
    const [at, end] = [chosen.stamp_nanos, newestNanos].map((nanos) => stopwatchText((nanos - this.firstNanos) * 1e-9));
    return `${at} of ${end}, keyframe ${ix + 1} of ${this.ordered.length}, camera ${chosen.camera}`;
  }
}
