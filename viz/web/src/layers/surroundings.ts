// Requests the depth around the eye in all directions while it moves, so that it can stop before surfaces.

import { worldFromCamera } from "../view/convention";
import { decodeDepth } from "./depth_part";
import { PanoramaDepthMap } from "./depth_map";
import type { View } from "../connection/render_scheduler";
import type { PictureRequest, SideView } from "./side_view";

/** The server sends depth at half of this size. */
const SIZE_PX: [number, number] = [192, 96];
/** Pause between two requests, and the fraction of the time that the server may spend on them. */
const PAUSE_MILLIS = 150;
const MAX_TIME_FRAC = 0.25;
/** Minimum time between two requests for the same eye while the model changes. */
const REFRESH_MILLIS = 2000;
/** The page does not wait longer than this for an answer. */
const TIMEOUT_MILLIS = 30_000;

export class Surroundings {
  private requestedFor = "";
  private requestedAt = 0;
  private dueAt = 0;
  private hasUpdate = false;
  /** Counts the calls of `forget`. Answers to requests before the last call are dropped. */
  private generation = 0;

  constructor(
    private readonly side: SideView,
    private readonly picture: (view: View) => Omit<PictureRequest, "outputs">,
    private readonly adopt: (map: PanoramaDepthMap) => void,
    private readonly fail: () => void,
  ) {}

  /** Called for every display refresh while the depth is needed. `follows` also requests it after changes of the model. */
  tick(view: () => View, method: string | undefined, follows: boolean): void {
    const now = performance.now();
    if (this.side.isWaiting && now - this.requestedAt > TIMEOUT_MILLIS) this.side.abandon("no answer");
    if (this.side.isWaiting || now < this.dueAt || !this.side.isPossible) return;
    const current = view();
    const { world_from_camera: pose, crop } = current;
    const key = JSON.stringify([pose[3], pose[7], pose[11], crop, method]);
    const isOutdated = follows && this.hasUpdate && now - this.requestedAt > REFRESH_MILLIS;
    if (key === this.requestedFor && !isOutdated) return;
    this.requestedFor = key;
    void this.request(current);
  }

  /** Called when the model has changed a little. */
  modelChanged(): void {
    this.hasUpdate = true;
  }

  /** Drops a pending answer, which shows another model, and requests the depth again even if the eye does not move. */
  forget(): void {
    this.generation += 1;
    this.requestedFor = "";
    this.side.abandon("the model is another one");
  }

  private async request(view: View): Promise<void> {
    const { generation } = this;
    this.requestedAt = performance.now();
    this.hasUpdate = false;
    let millis = 0;
    try {
      const { header, payload } = await this.side.request({
        ...this.picture(view),
        projection: { kind: "equirectangular" },
        size_px: SIZE_PX,
        outputs: ["depth"],
      });
      millis = header.render_millis;
      const decoded = header.depth ? await decodeDepth(header.depth, payload) : null;
      if (generation !== this.generation || !decoded) return;
      this.adopt(new PanoramaDepthMap(worldFromCamera(header.world_from_camera), decoded.depth, decoded.sizePx));
    } catch {
      if (generation === this.generation) this.fail(); // The pictures of the main view still show surfaces.
    } finally {
      this.dueAt = performance.now() + Math.max(PAUSE_MILLIS, millis * (1 / MAX_TIME_FRAC - 1));
    }
  }
}
