// Measures the time from the shutter of a camera to the screen. It is the time from mid-exposure of
// a keyframe until the first picture of a model with this keyframe is presented.
//
// A picture counts only if it contains a keyframe that the previous picture did not contain.
// Otherwise, the age of its keyframes would also contain the time without new keyframes, which is
// not latency.

import type { Connection } from "./connection";
import { SLOW_MILLIS } from "./flow";
import { element } from "../panels/element";
import { latencyText } from "../panels/quantities";
import type { PictureHeader } from "./protocol";

/** Time window of the statistics. */
const WINDOW_MILLIS = 60_000;
/** Minimum time between two reports to the server. */
const REPORT_MILLIS = 100;
const SHOW_MILLIS = 1000;

/** Times of the newest keyframe of a picture, milliseconds. */
interface Sample {
  shownAt: number;
  total: number;
  toModel: number;
  toPicture: number;
  sending: number;
  showing: number;
}

interface Arrived {
  header: PictureHeader;
  receivedAt: number;
}

export class ShownLatency {
  private samples: Sample[] = [];
  /** Number of keyframes in the last presented picture; null if the page has not waited for keyframes since then. */
  private nKeyframes: number | null = null;
  /** The picture that the next frame draws. */
  private ready: Arrived | null = null;
  /** The picture that the last frame has drawn. */
  private drawn: Arrived | null = null;
  private reportedAt = -Infinity;

  constructor(private readonly connection: Connection) {
    window.setInterval(() => this.show(), SHOW_MILLIS);
    document.addEventListener("visibilitychange", () => this.restart());
  }

  /** Called when the next frame will draw a picture that was received at `receivedAt`. */
  pictureReady(header: PictureHeader, receivedAt: number): void {
    if (header.last) this.ready = { header, receivedAt };
  }

  /** Called at the beginning of a frame, when the browser has taken over the drawing of the last frame. */
  frameBegins(): void {
    if (this.drawn) this.presented(this.drawn);
    this.drawn = this.ready;
    this.ready = null;
  }

  /**
   * To be called if the next picture may contain keyframes for which the page has not waited, or
   * may show another model.
   */
  restart(): void {
    this.nKeyframes = null;
    this.ready = null;
    this.drawn = null;
  }

  /** Discards the samples, too. */
  forget(): void {
    this.restart();
    this.samples = [];
    this.show();
  }

  private presented({ header, receivedAt }: Arrived): void {
    const { keyframes, newest_keyframe: newest } = header;
    if (keyframes === null) return;
    const isNew = this.nKeyframes !== null && keyframes > this.nKeyframes;
    this.nKeyframes = Math.max(keyframes, this.nKeyframes ?? 0);
    const shownAt = performance.now();
    const shownMillis = this.connection.clock.serverMillis(shownAt);
    const receivedMillis = this.connection.clock.serverMillis(receivedAt);
    if (!isNew || !newest || shownMillis === null || receivedMillis === null) return;
    this.samples.push({
      shownAt,
      total: shownMillis - newest.captured_millis,
      toModel: newest.added_millis - newest.captured_millis,
      toPicture: header.sent_millis - newest.added_millis,
      sending: receivedMillis - header.sent_millis,
      showing: shownMillis - receivedMillis,
    });
    if (this.connection.supports("shown") && shownAt - this.reportedAt >= REPORT_MILLIS) {
      this.reportedAt = shownAt;
      this.connection.send({ type: "shown", id: header.id, shown_millis: Math.max(0, shownMillis) });
    }
  }

  private show(): void {
    const oldest = performance.now() - WINDOW_MILLIS;
    this.samples = this.samples.filter((sample) => sample.shownAt > oldest);
    const label = element("shown-text");
    label.hidden = this.samples.length === 0;
    if (label.hidden) return;
    const millis = (part: (sample: Sample) => number, frac = 0.5): string =>
      latencyText(quantile(this.samples.map(part), frac));
    const total = (sample: Sample): number => sample.total;
    label.textContent = `camera to screen ${millis(total)}`;
    label.classList.toggle("late", quantile(this.samples.map(total), 0.5) > SLOW_MILLIS);
    label.title = [
      `Time from mid-exposure of a keyframe to its first picture on this screen, in the last minute (${this.samples.length}):`,
      `median ${millis(total)}, 99 % below ${millis(total, 0.99)}.`,
      "Medians of the parts:",
      `camera to model ${millis((sample) => sample.toModel)}`,
      `model to picture ${millis((sample) => sample.toPicture)}`,
      `sending ${millis((sample) => sample.sending)}`,
      `showing ${millis((sample) => sample.showing)}`,
    ].join("\n");
  }
}

/** The value below or at which this fraction of the values lies. */
function quantile(values: number[], frac: number): number {
  const sorted = values.sort((a, b) => a - b);
  return sorted[Math.floor((sorted.length - 1) * frac)]!;
}
