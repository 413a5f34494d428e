// Requests photographs of keyframes, one at a time.

import type { Connection } from "./connection";
import type { ErrorMessage, KeyframeImageHeader, KeyframeImageMessage, NumberedKeyframe } from "./protocol";

/** A photograph as it arrived. */
export interface Photo {
  header: KeyframeImageHeader;
  payload: Uint8Array<ArrayBuffer>;
}

interface Waiting {
  keyframe: NumberedKeyframe;
  sizePx: [number, number];
  resolve(photo: Photo): void;
  reject(error: Error): void;
}

export class KeyframePhotos {
  private id = 0;
  private pending: Waiting | null = null;
  private readonly queue: Waiting[] = [];

  constructor(private readonly connection: Pick<Connection, "isOpen" | "supports" | "send">) {}

  /** Whether the server sends photographs. */
  get isPossible(): boolean {
    return this.connection.isOpen && this.connection.supports("keyframe_images");
  }

  /** Requests a photograph of at most this size. Urgent requests come before the others. */
  request(keyframe: NumberedKeyframe, sizePx: [number, number], isUrgent: boolean): Promise<Photo> {
    return new Promise((resolve, reject) => {
      const waiting = { keyframe, sizePx, resolve, reject };
      if (isUrgent) this.queue.unshift(waiting);
      else this.queue.push(waiting);
      this.next();
    });
  }

  /** Takes a message if it is a photograph. Returns whether it was. */
  receive(header: { type: string }, payload: Uint8Array<ArrayBuffer>): boolean {
    if (header.type !== "keyframe_image") return false;
    const photo = header as KeyframeImageHeader;
    if (photo.id !== this.id || !this.pending) return true;
    const { keyframe, resolve, reject } = this.pending;
    this.pending = null;
    // A server that was started again uses the same numbers for other keyframes.
    const isSame = photo.camera === keyframe.camera && photo.stamp_nanos === keyframe.stamp_nanos;
    if (isSame) resolve({ header: photo, payload });
    else reject(new Error("the list of keyframes has changed"));
    this.next();
    return true;
  }

  /** Takes an error if it is about a photograph. Returns whether it was. */
  fail({ id, keyframe, message }: ErrorMessage): boolean {
    if (keyframe === undefined) return false;
    if (id === this.id && this.pending) {
      const { reject } = this.pending;
      this.pending = null;
      reject(new Error(message));
      this.next();
    }
    return true;
  }

  /** Ends all requests with an error, because a new connection does not know them. */
  restart(): void {
    const ended = [...(this.pending ? [this.pending] : []), ...this.queue.splice(0)];
    this.pending = null;
    for (const { reject } of ended) reject(new Error("the connection was interrupted"));
  }

  private next(): void {
    if (this.pending) return;
    const next = this.queue.shift();
    if (!next) return;
    this.pending = next;
    this.id += 1;
    const message: KeyframeImageMessage = {
      type: "keyframe_image",
      id: this.id,
      keyframe: next.keyframe.id,
      size_px: next.sizePx,
    };
    this.connection.send(message);
  }
}
