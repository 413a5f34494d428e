// Decides which picture to request and when.
//
// While the view moves, one small picture is requested at a time, as large as the latency allows.
// At rest, the finer stages are requested. While the model trains, the full picture is refreshed
// periodically.

import type { Connection } from "./connection";
import type { Crop } from "../view/crop_box";
import type { PictureHeader, Pinhole, RenderMessage } from "./protocol";
import type { PictureRequest } from "../layers/side_view";

/** The current view of the page. */
export interface View {
  world_from_camera: number[];
  size_px: [number, number];
  projection: Pinhole;
  near_m: number;
  far_m: number;
  crop: Crop | undefined;
}

const REST_MILLIS = 180;
/** Minimum pause between two refreshes. */
const REFRESH_MILLIS = 150;
/** Maximum fraction of the time spent on refreshes, and thus of the bandwidth. */
const REFRESH_SHARE = 0.25;
/** Minimum pause between two refreshes if the page draws the model itself and needs only the depth. */
const LOCAL_REFRESH_MILLIS = 3000;
/**
 * Time after a change for which the model counts as changing. The status, which reports changes,
 * arrives twice a second.
 */
const CHANGING_MILLIS = 1200;
/**
 * While the view moves, pictures that take longer than this are requested smaller. Pictures that
 * take less than a third of it are requested larger.
 */
const MOVING_MILLIS = 110;
const MOVING_SCALES = [0.1, 0.15, 0.25, 0.35, 0.5, 0.7, 1];
/** Timeouts for answers, while moving and at rest. */
const TIMEOUT_MILLIS = { moving: 3000, resting: 30_000 };

/** Observes which picture is wanted and which one is requested. */
export interface RequestObserver {
  /** Another view, model or part of the scene is wanted than in the requests so far. */
  viewChanged(): void;
  /** A picture of the wanted view and model was requested. */
  requested(id: number): void;
}

export class RenderScheduler {
  private id = 0;
  private requestedAt = 0;
  private finishedAt = 0;
  private lastMillis = 0;
  private movedAt = -Infinity;
  private movingIx = 0;
  /** Scale of the newest picture of the moving view; later pictures are not coarser. */
  private movingScale = 0;
  private isWaiting = false;
  private isResting = false;
  private hasUpdate = false;
  private changedAt = -Infinity;
  /** Whether the next picture is requested as soon as the previous one has arrived, while the model changes. */
  isContinuous = false;
  /** Whether the page draws the model itself. Then, only the depth of the resting view is requested. */
  private isLocal = false;

  constructor(
    private readonly connection: Connection,
    private readonly view: () => View,
    private readonly stages: () => number[],
    private readonly background: [number, number, number],
    private readonly method: () => string | undefined,
    private readonly observer?: RequestObserver,
  ) {}

  /** Called when the view has changed. */
  moved(): void {
    this.movedAt = performance.now();
    this.observer?.viewChanged();
    // The full picture of the old view is not awaited, because the next request replaces it.
    if (this.isResting) this.isWaiting = false;
    this.isResting = false;
  }

  /** Sets whether the page draws the model itself. */
  set drawsLocally(isLocal: boolean) {
    if (isLocal === this.isLocal) return;
    this.isLocal = isLocal;
    this.restart();
  }

  /** Called when the model has changed. */
  modelChanged(): void {
    this.hasUpdate = true;
    this.changedAt = performance.now();
  }

  /** Discards pending requests, which will not be answered. */
  restart(): void {
    this.observer?.viewChanged();
    this.isWaiting = false;
    this.isResting = false;
  }

  /** Called when a picture arrives. Returns the time since its request, milliseconds. */
  answered(header: PictureHeader): number {
    const millis = performance.now() - this.requestedAt;
    if (header.id !== this.id || !header.last) return millis;
    this.isWaiting = false;
    this.finishedAt = performance.now();
    this.lastMillis = millis;
    if (!this.isResting) {
      this.movingScale = header.scale;
      this.adapt(millis);
    }
    return millis;
  }

  /** Called when the requested picture will not arrive. */
  failed(id: number | null): void {
    if (id === this.id) this.isWaiting = false;
  }

  /** Called for every display refresh. */
  tick(): void {
    if (!this.connection.isOpen) return;
    const now = performance.now();
    const timeout = this.isResting ? TIMEOUT_MILLIS.resting : TIMEOUT_MILLIS.moving;
    if (now - this.requestedAt > timeout) this.isWaiting = false;
    if (!this.isResting && now - this.movedAt > REST_MILLIS) {
      this.isResting = true;
      const finer = (this.isLocal ? [1] : this.stages()).filter((scale) => scale > this.movingScale);
      this.movingScale = 0;
      this.request(finer.length > 0 ? finer : [1]); // Replaces any pending request.
    } else if (!this.isResting && !this.isWaiting && !this.isLocal) {
      this.request([MOVING_SCALES[this.movingIx]!]);
    } else if (this.isResting && !this.isWaiting && (this.hasUpdate || this.isChanging(now))) {
      const period = this.isLocal ? LOCAL_REFRESH_MILLIS : REFRESH_MILLIS;
      const pause = this.isContinuous ? 0 : Math.max(period, this.lastMillis * (1 / REFRESH_SHARE - 1));
      if (now - this.finishedAt > pause) this.request([1]);
    }
  }

  /** Whether the model is probably changing. Depth alone is only requested after known changes. */
  private isChanging(now: number): boolean {
    return !this.isLocal && now - this.changedAt < CHANGING_MILLIS;
  }

  private request(stages: number[]): void {
    this.id += 1;
    this.requestedAt = performance.now();
    this.isWaiting = true;
    this.hasUpdate = false;
    const outputs: RenderMessage["outputs"] = this.isLocal ? ["depth"] : ["color", "depth"];
    this.connection.send({ type: "render", id: this.id, ...this.picture(this.view()), stages, outputs });
    this.observer?.requested(this.id);
  }

  /** The part of a request that other views have in common with the main view. */
  picture(view: View): Omit<PictureRequest, "outputs"> {
    return {
      ...view,
      method: this.method(), // Omitted from the message if undefined.
      depth_format: this.connection.supports("compact_depth") ? "compact_half" : undefined,
      background_srgb: this.background,
    };
  }

  private adapt(millis: number): void {
    if (millis > MOVING_MILLIS) this.movingIx = Math.max(0, this.movingIx - 1);
    else if (millis < MOVING_MILLIS / 3) this.movingIx = Math.min(MOVING_SCALES.length - 1, this.movingIx + 1);
  }
}
