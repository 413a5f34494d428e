// The photograph of the keyframe at the time of the slider.

import type { KeyframePhotos } from "../connection/keyframe_photos";
import type { NumberedKeyframe } from "../connection/protocol";
import { decodeJpeg, drawBitmap } from "../layers/jpeg";
import { element } from "./element";
import { keyframeKey } from "./keyframe_order";

/** Maximum size: twice the width of the panel, for dense screens. */
const SIZE_PX: [number, number] = [560, 560];

export class TimePhoto {
  private readonly canvas = element("history-photo", HTMLCanvasElement);
  private wanted: NumberedKeyframe | null = null;
  private shownKey = "";
  private isBusy = false;

  constructor(private readonly photos: KeyframePhotos) {}

  /** Shows the photograph of a keyframe, or nothing. */
  show(keyframe: NumberedKeyframe | null): void {
    this.wanted = keyframe;
    if (!keyframe || !this.photos.isPossible) this.hide();
    else if (!this.isBusy && keyframeKey(keyframe) !== this.shownKey) void this.request();
  }

  private hide(): void {
    this.canvas.hidden = true;
    this.shownKey = "";
  }

  /** Requests photographs until the wanted one is shown. While the slider moves, most keyframes are skipped. */
  private async request(): Promise<void> {
    this.isBusy = true;
    for (let next = this.wanted; next && keyframeKey(next) !== this.shownKey; next = this.pending(next)) {
      try {
        await this.draw(next);
        this.shownKey = keyframeKey(next);
      } catch {
        // The run has dropped the keyframe, or the connection was lost.
        this.hide();
        if (next === this.wanted) break;
      }
    }
    this.isBusy = false;
  }

  /** The wanted keyframe, if it differs from the shown one. */
  private pending(shown: NumberedKeyframe): NumberedKeyframe | null {
    return this.wanted && keyframeKey(this.wanted) !== keyframeKey(shown) ? this.wanted : null;
  }

  private async draw(keyframe: NumberedKeyframe): Promise<void> {
    const { header, payload } = await this.photos.request(keyframe, SIZE_PX, true);
    drawBitmap(this.canvas, await decodeJpeg(payload, header.color));
    this.canvas.hidden = this.wanted === null;
  }
}
