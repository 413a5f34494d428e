// Describes the drawn picture, and determines whether it shows the wanted view and model. This is a
// state machine without DOM.
//
// The view and the model that the operator wants change at any time. Each request is for the view
// and model that are wanted at that time. A picture is current as long as nothing has changed since
// its request. All facts about a picture come from the header that was drawn, so that a label can
// be late, but never describes another picture.

import type { PictureHeader } from "../connection/protocol";
import { ageText, durationText } from "./quantities";

/** A drawn picture is noticeably outdated after this time. */
const OLD_MILLIS = 1000;

/** The parts of a header that describe a picture. */
export type DrawnHeader = Pick<PictureHeader, "id" | "method" | "step" | "scale" | "size_px" | "sent_millis">;

/**
 * `current`: the picture shows the wanted view and model. `waiting`: the view has changed since, or
 * there is no picture. `old`: a complete picture of the wanted view has been missing for more than
 * a second, or the picture shows another model.
 */
export type PictureState = "current" | "waiting" | "old";

export interface PictureStatus {
  state: PictureState;
  /** Whether view and model are the wanted ones, possibly at a lower resolution. */
  isOfView: boolean;
  /** How long the operator has been waiting for another picture; null if it is complete or there is no connection. */
  waitingMillis: number | null;
  /** Whether pictures can arrive. */
  isConnected: boolean;
  /** Newest request. */
  request: number | null;
}

export class PictureLabel {
  /** When each request became outdated; null as long as its view and model are wanted. */
  private readonly outdatedAt = new Map<number, number | null>();
  private newest: number | null = null;
  /** The first request of the wanted model. */
  private firstOfModel = 0;
  private firstRequestAt: number | null = null;
  /** When the drawn picture, or a finer stage of it, was drawn. */
  private drawnAt = 0;
  private drawn: DrawnHeader | null = null;
  /** When the present connection was opened; null without a connection. */
  private connectedAt: number | null = -Infinity;

  /** Nothing is awaited without a connection, and the wait begins anew with the next one. */
  setConnected(isConnected: boolean, now: number): void {
    this.connectedAt = isConnected ? (this.connectedAt ?? now) : null;
  }

  /** Another view is wanted. */
  viewChanged(now: number): void {
    for (const [id, at] of this.outdatedAt) if (at === null) this.outdatedAt.set(id, now);
  }

  /** Another model is wanted. */
  modelChanged(now: number): void {
    this.viewChanged(now);
    this.firstOfModel = (this.newest ?? -1) + 1;
  }

  /** A picture of the wanted view and model was requested. Numbers of requests grow. */
  requested(id: number, now: number): void {
    this.newest = id;
    this.firstRequestAt ??= now;
    this.outdatedAt.set(id, null);
  }

  /** Whether a picture may be drawn. Late stages of another model must not be drawn. */
  accepts({ id }: Pick<DrawnHeader, "id">): boolean {
    return id >= this.firstOfModel;
  }

  /** Adopts the header of the picture that is drawn from now on; null if none is drawn. */
  show(header: DrawnHeader | null, now: number): void {
    if (header === this.drawn) return;
    this.drawn = header;
    this.drawnAt = now;
    if (!header) {
      this.firstRequestAt = null; // The page waits for the next request from now on.
      return;
    }
    // Earlier requests cannot be drawn any more.
    for (const id of this.outdatedAt.keys()) if (id < header.id) this.outdatedAt.delete(id);
  }

  /** The header of the drawn picture. */
  get header(): DrawnHeader | null {
    return this.drawn;
  }

  status(now: number): PictureStatus {
    const wanted = this.wanted(now);
    const { connectedAt } = this;
    const isConnected = connectedAt !== null;
    const waitingMillis = isConnected ? wanted.waitingMillis && Math.min(wanted.waitingMillis, now - connectedAt) : null;
    return { ...wanted, waitingMillis, isConnected };
  }

  /** The status, with the time since another picture is wanted, whether or not there is a connection. */
  private wanted(now: number): Omit<PictureStatus, "isConnected"> {
    const request = this.newest;
    if (!this.drawn) {
      const waitingMillis = this.firstRequestAt === null ? null : now - this.firstRequestAt;
      return { state: "waiting", isOfView: false, waitingMillis, request };
    }
    // A request that is not known was made before the picture that was drawn last, so it is outdated.
    const outdatedAt = this.outdatedAt.has(this.drawn.id) ? this.outdatedAt.get(this.drawn.id)! : this.drawnAt;
    const isOfView = outdatedAt === null;
    if (isOfView && this.drawn.scale >= 1 - 1e-9) return { state: "current", isOfView, waitingMillis: null, request };
    const waitingMillis = now - (outdatedAt ?? this.drawnAt);
    const isOfOtherModel = this.drawn.id < this.firstOfModel;
    if (isOfOtherModel || waitingMillis > OLD_MILLIS) return { state: "old", isOfView, waitingMillis, request };
    return { state: isOfView ? "current" : "waiting", isOfView, waitingMillis, request };
  }
}

/** The label of a picture. `answerMillis`: time from its request to its arrival. `ageMillis`: null if it is not old. */
export function labelText(
  header: DrawnHeader | null,
  { isOfView, waitingMillis, state, isConnected }: PictureStatus,
  answerMillis: number,
  ageMillis: number | null,
): string {
  const wait = isConnected ? waitingText(waitingMillis) : " · no connection";
  if (!header) return `no picture yet${wait}`;
  const age = ageMillis !== null && ageMillis > OLD_MILLIS ? ageText(ageMillis) : "";
  const what = [header.method ?? "", age].filter((part) => part !== "").join(", ");
  const [width, height] = header.size_px;
  const size = `${width} × ${height} (${Math.round(100 * header.scale)} %)`;
  const isLate = state !== "current";
  const details = isOfView ? (isLate ? size : `${size} in ${answerMillis.toFixed(0)} ms`) : "";
  const text = [what, details].filter((part) => part !== "").join(" · ");
  return isLate || !isConnected ? `${text}${wait}`.replace(/^ · /, "") : text;
}

function waitingText(millis: number | null): string {
  if (millis === null) return "";
  // Fast pictures of a moving view would otherwise show changing numbers that mean nothing.
  return millis < 300 ? " · waiting" : ` · waiting ${durationText(millis / 1000)}`;
}
