// Receives the pictures of the main view, and shows why a picture is missing.

import type { PictureHeader } from "../connection/protocol";
import type { RenderScheduler } from "../connection/render_scheduler";
import type { ShownLatency } from "../connection/shown_latency";
import { element } from "../panels/element";
import { setText } from "../panels/html";
import type { PictureInfo } from "../panels/picture_info";
import { reasonOf } from "../panels/sentence";
import type { Skeleton } from "../panels/skeleton";
import type { OrbitView } from "./orbit_view";

export interface PictureParts {
  view: OrbitView;
  scheduler: RenderScheduler;
  skeleton: Skeleton;
  info: PictureInfo;
  latency: ShownLatency;
  /** Whether the user wants to see the model. */
  isModelVisible: () => boolean;
}

export class MainPicture {
  private readonly notice = element("notice");

  constructor(private readonly parts: PictureParts) {}

  async receive(header: PictureHeader, payload: Uint8Array<ArrayBuffer>): Promise<void> {
    const { view, scheduler, skeleton, info, latency } = this.parts;
    const millis = scheduler.answered(header);
    const receivedAt = performance.now();
    try {
      if (!(await view.picture.show(header, payload, view.emptyDepth))) return;
    } catch (error) {
      this.failed(header.id, `Cannot show a picture: ${reasonOf(error)}`);
      return;
    }
    if (header.color && this.parts.isModelVisible()) latency.pictureReady(header, receivedAt);
    else latency.restart();
    skeleton.pictureShown(view.picture.posedDepth?.depth ?? null);
    if (header.color) view.local.pictureArrived();
    view.changed();
    view.seePicture();
    setText(this.notice, "");
    if (header.color) info.drawn(millis);
  }

  /** Called when a requested picture will not arrive. */
  failed(id: number | null, reason: string): void {
    this.parts.scheduler.failed(id);
    setText(this.notice, reason);
  }
}
