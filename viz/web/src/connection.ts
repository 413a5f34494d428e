// The WebSocket: opens it, opens it again when it breaks, hands messages on.

import { type BinaryHeader, PROTOCOL_VERSION, type RenderMessage, type TextMessage, unframe } from "./protocol";

const RETRY_MILLIS = 1000;

export type ConnectionState = "connecting" | "open" | "lost";

export interface ConnectionEvents {
  state(state: ConnectionState, text: string): void;
  text(message: TextMessage): void;
  binary(header: BinaryHeader, payload: Uint8Array<ArrayBuffer>): void;
}

export class Connection {
  private socket: WebSocket | null = null;
  private goodbye = "";

  constructor(private readonly url: string, private readonly events: ConnectionEvents) {
    this.open();
  }

  get isOpen(): boolean {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  send(message: RenderMessage): void {
    if (this.isOpen) this.socket?.send(JSON.stringify(message));
  }

  private open(): void {
    const socket = new WebSocket(this.url);
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => this.receive(event.data as string | ArrayBuffer);
    socket.onclose = () => {
      this.events.state("lost", this.goodbye ? `${this.goodbye}, trying again` : "no connection, trying again");
      window.setTimeout(() => this.open(), RETRY_MILLIS);
    };
    this.socket = socket;
  }

  private receive(data: string | ArrayBuffer): void {
    if (typeof data !== "string") {
      const { header, payload } = unframe(data);
      this.events.binary(header, payload);
      return;
    }
    const message = JSON.parse(data) as TextMessage;
    if (message.type === "hello") {
      this.goodbye = "";
      if (message.protocol === PROTOCOL_VERSION) {
        this.events.state("open", `connected to ${location.host}`);
      } else {
        this.goodbye = "this page is of another version than the server, reload it";
        this.socket?.close();
        return;
      }
    } else if (message.type === "goodbye") {
      this.goodbye = message.reason;
    }
    this.events.text(message);
  }
}
