// Joins the parts of a long binary message. The server sends the parts of one message at a time, in order.

import type { PartHeader } from "./protocol";

/** Longer messages are ignored. The largest pictures, with depth as floats, have about 100 MiB. */
const MAX_BYTES = 256 * 1024 * 1024;

export class PartJoiner {
  private message = -1;
  private bytes = new Uint8Array(0);
  private nJoined = 0;

  /** Adds a part. Returns the message if it is complete. */
  add(header: PartHeader, payload: Uint8Array): ArrayBuffer | null {
    if (header.offset === 0) {
      this.forget();
      if (!(header.bytes <= MAX_BYTES)) return null;
      this.message = header.message;
      this.bytes = new Uint8Array(header.bytes);
    }
    const isNext = header.message === this.message && header.offset === this.nJoined;
    if (!isNext || header.offset + payload.length > this.bytes.length) return null;
    this.bytes.set(payload, header.offset);
    this.nJoined += payload.length;
    if (this.nJoined < this.bytes.length) return null;
    const { buffer } = this.bytes;
    this.forget();
    return buffer;
  }

  /** Discards an incomplete message. */
  forget(): void {
    this.message = -1;
    this.bytes = new Uint8Array(0);
    this.nJoined = 0;
  }
}
