// The WebSocket /steer: opens it, and opens it again after a failure. Its own connection, so that no picture delays a command.

import { parseMessage, type SteerMessage, type SteerRequest } from "./messages";

/** Pauses before the next attempts. */
const RETRY_MILLIS = [250, 500, 1000, 2000];
/** An attempt, or a silence, of this length ends the connection. */
const GIVE_UP_MILLIS = 4000;
/** With more unsent bytes than this, the link does not keep up. Samples are then left out, because the next one replaces them. */
const MAX_BUFFERED_BYTES = 4096;

export interface SocketEvents {
  opened(): void;
  closed(): void;
  message(message: SteerMessage): void;
}

export class SteerSocket {
  private socket: WebSocket | null = null;
  private isWanted = false;
  private nRetries = 0;
  private retryAt = 0;
  private receivedAt = 0;

  constructor(
    private readonly url: string,
    private readonly events: SocketEvents,
  ) {}

  /** Sets whether the server has this socket. */
  set wanted(isWanted: boolean) {
    this.isWanted = isWanted;
    if (!isWanted) this.close();
    else if (!this.socket) this.open();
  }

  send(request: SteerRequest): void {
    const { socket } = this;
    if (socket?.readyState !== WebSocket.OPEN) return;
    const isSample = request.type === "command" && request.grip !== null;
    if (isSample && socket.bufferedAmount > MAX_BUFFERED_BYTES) return;
    socket.send(JSON.stringify(request));
  }

  /** Called a few times a second. */
  check(): void {
    const now = performance.now();
    if (!this.isWanted) return;
    if (!this.socket && now >= this.retryAt) this.open();
    else if (this.socket && now - this.receivedAt > GIVE_UP_MILLIS) this.close();
  }

  private open(): void {
    const socket = new WebSocket(this.url);
    this.socket = socket;
    this.receivedAt = performance.now();
    socket.onopen = () => socket === this.socket && this.events.opened();
    socket.onclose = () => socket === this.socket && this.close();
    socket.onmessage = ({ data }) => {
      if (socket !== this.socket) return;
      this.receivedAt = performance.now();
      const message = typeof data === "string" ? parseMessage(data) : null;
      if (message?.type === "arm") this.nRetries = 0;
      if (message) this.events.message(message);
    };
  }

  private close(): void {
    const { socket } = this;
    if (!socket) return;
    this.socket = null;
    socket.close();
    this.retryAt = performance.now() + RETRY_MILLIS[Math.min(this.nRetries, RETRY_MILLIS.length - 1)]!;
    this.nRetries += 1;
    this.events.closed();
  }
}
