// Single pictures for a named view, requested beside those of the main view.

import type { Connection } from "../connection/connection";
import type { ErrorMessage, PictureHeader, RenderMessage } from "../connection/protocol";

/** A request for a picture, without its number and its view, which are added here. */
export type PictureRequest = Omit<RenderMessage, "type" | "id" | "view" | "stages">;

/** A picture as it arrived. */
export interface SidePicture {
  header: PictureHeader;
  payload: Uint8Array<ArrayBuffer>;
}

interface Waiting {
  message: RenderMessage;
  resolve(picture: SidePicture): void;
  reject(error: Error): void;
}

export class SideView {
  private id = 0;
  private waiting: Waiting | null = null;

  constructor(
    private readonly connection: Connection,
    private readonly name: string,
  ) {}

  /** Whether the server draws other views than the main one. */
  get isPossible(): boolean {
    return this.connection.isOpen && this.connection.supports("views");
  }

  get isWaiting(): boolean {
    return this.waiting !== null;
  }

  /** Requests a picture in one stage. A pending request is abandoned. */
  request(picture: PictureRequest): Promise<SidePicture> {
    this.abandon("another picture was requested");
    this.id += 1;
    const message: RenderMessage = { type: "render", id: this.id, view: this.name, stages: [1], ...picture };
    this.connection.send(message);
    return new Promise((resolve, reject) => (this.waiting = { message, resolve, reject }));
  }

  /** Ends the pending request with an error. */
  abandon(reason: string): void {
    this.waiting?.reject(new Error(reason));
    this.waiting = null;
  }

  /** Sends the pending request again, because a new connection does not know it. */
  restart(): void {
    if (this.waiting) this.connection.send(this.waiting.message);
  }

  /** Takes a picture if it is of this view. Returns whether it was. */
  receive(header: PictureHeader, payload: Uint8Array<ArrayBuffer>): boolean {
    if (header.view !== this.name) return false;
    if (header.id === this.waiting?.message.id) {
      this.waiting.resolve({ header, payload });
      this.waiting = null;
    }
    return true;
  }

  /** Takes an error if it is about this view. Returns whether it was. */
  fail({ view, id, message }: ErrorMessage): boolean {
    if (view !== this.name) return false;
    if (id === this.waiting?.message.id) this.abandon(message);
    return true;
  }
}
