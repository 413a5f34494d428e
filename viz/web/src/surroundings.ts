// Requests the depth around the eye in all directions while it moves, so that it can stop before surfaces.

import { worldFromCamera } from "./convention";
import { decodeDepth } from "./depth_part";
import { PanoramaDepthMap } from "./depth_map";
import type { View } from "./render_scheduler";
import type { PictureRequest, SideView } from "./side_view";

/** The server sends depth at half of this size. */
const SIZE_PX: [number, number] = [192, 96];
/** Pause between two requests, and the fraction of the time that may be spent on them. */
const PAUSE_MILLIS = 150;
const SHARE = 0.25;
/** An answer that is later than this is not waited for. */
const TIMEOUT_MILLIS = 30_000;

export class Surroundings {
  private requestedFor = "";
  private requestedAt = 0;
  private dueAt = 0;

  constructor(
    private readonly side: SideView,
    private readonly picture: (view: View) => Omit<PictureRequest, "outputs">,
    private readonly adopt: (map: PanoramaDepthMap) => void,
    private readonly fail: () => void,
  ) {}

  /** Called for every display refresh. */
  tick(view: View, method: string | undefined): void {
    const now = performance.now();
    if (this.side.isWaiting && now - this.requestedAt > TIMEOUT_MILLIS) this.side.abandon("no answer");
    if (this.side.isWaiting || now < this.dueAt || !this.side.isPossible) return;
    const { world_from_camera: pose, crop } = view;
    const key = JSON.stringify([pose[3], pose[7], pose[11], crop, method]);
    if (key === this.requestedFor) return;
    this.requestedFor = key;
    void this.request(view);
  }

  private async request(view: View): Promise<void> {
    this.requestedAt = performance.now();
    try {
      const { header, payload } = await this.side.request({
        ...this.picture(view),
        projection: { kind: "equirectangular" },
        size_px: SIZE_PX,
        outputs: ["depth"],
      });
      if (!header.depth) return;
      const { depth, sizePx } = await decodeDepth(header.depth, payload);
      this.adopt(new PanoramaDepthMap(worldFromCamera(header.world_from_camera), depth, sizePx));
    } catch {
      this.fail(); // The pictures of the main view still show surfaces.
    }
    this.dueAt = performance.now() + Math.max(PAUSE_MILLIS, (performance.now() - this.requestedAt) * (1 / SHARE - 1));
  }
}
