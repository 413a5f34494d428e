// The WebSocket: opens it, detects silence, reconnects after a failure, and forwards messages.

import { refusalReason } from "./access";
import { agree } from "./negotiation";
import { PartJoiner } from "./part_joiner";
import { type BinaryHeader, type Capability, type ClientMessage, type TextMessage, unframe } from "./protocol";
import { ServerClock } from "./server_clock";

const CHECK_MILLIS = 100;
const PING_MILLIS = 500;
/** The server sends four heartbeats a second, so a silence of this length indicates a problem. */
const SILENT_MILLIS = 800;
/** After this much silence, the page reconnects. */
const GIVE_UP_MILLIS = 4000;
/** An attempt that receives no message within this time is abandoned. */
const ATTEMPT_MILLIS = 2000;
/** Pauses before the next attempts. A server on this computer or behind a tunnel is usually back within a second. */
const RETRY_MILLIS = [250, 500, 1000];
/** If a check is this late, messages from the server may be queued. They are handled before the check. */
const LATE_MILLIS = 400;
/** If a check is this late, the page or the computer was suspended. */
const SUSPENDED_MILLIS = 5000;

export type ConnectionState = "connecting" | "open" | "silent" | "lost" | "refused";

export interface ConnectionEvents {
  state(state: ConnectionState, text: string): void;
  text(message: TextMessage): void;
  binary(header: BinaryHeader, payload: Uint8Array<ArrayBuffer>): void;
}

export class Connection {
  readonly clock = new ServerClock();
  /** Bytes received since the page was opened. */
  nReceived = 0;
  /** Time from the last ping to its answer; null before the first answer of a connection. */
  roundTripMillis: number | null = null;
  private readonly parts = new PartJoiner();
  /**
   * Capabilities of the last server until the next hello, so that the page still offers functions
   * that need no server.
   */
  private capabilities: ReadonlySet<string> = new Set();
  private socket: WebSocket | null = null;
  private goodbye = "";
  /** Whether the server has announced its end, and no server has answered since. */
  hasStopped = false;
  /** Whether the current socket has received a hello. */
  private hasHello = false;
  private refusal = "";
  private state: ConnectionState = "connecting";
  private receivedAt = performance.now();
  private pingedAt = -Infinity;
  private checkedAt = performance.now();
  private lostAt = 0;
  private retryAt = 0;
  private nRetries = 0;

  /** `topicCapabilities` is called when a server has sent its capabilities. */
  constructor(
    private readonly url: string,
    private readonly events: ConnectionEvents,
    private readonly topicCapabilities: () => readonly string[],
  ) {
    this.open();
    window.setInterval(() => {
      const late = performance.now() - this.checkedAt;
      // Without a connection, no answer would make the ages known again.
      if (late > SUSPENDED_MILLIS && this.isOpen) this.clock.forget();
      if (late > LATE_MILLIS) window.setTimeout(() => this.check(), 0);
      else this.check();
    }, CHECK_MILLIS);
  }

  get isOpen(): boolean {
    return this.socket?.readyState === WebSocket.OPEN && (this.state === "open" || this.state === "silent");
  }

  /** Whether the server has a capability that the page can use. */
  supports(capability: Capability): boolean {
    return this.capabilities.has(capability);
  }

  /** Whether the server has a topic with this capability. */
  supportsTopic(capability: string): boolean {
    return this.capabilities.has(capability);
  }

  send(message: ClientMessage): void {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  private open(): void {
    const socket = new WebSocket(this.url);
    socket.binaryType = "arraybuffer";
    // A first message shows the server that the client is in use. The server replaces silent clients.
    socket.onopen = () => this.ping();
    socket.onmessage = (event) => {
      if (socket === this.socket) this.receive(event.data as string | ArrayBuffer);
    };
    socket.onclose = () => {
      if (socket === this.socket) this.disconnect();
    };
    this.socket = socket;
    this.hasHello = false;
    this.parts.forget();
    this.receivedAt = performance.now();
    this.roundTripMillis = null;
  }

  /** Abandons the socket; a new one is opened after a pause. */
  private disconnect(): void {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    const now = performance.now();
    if (this.state !== "lost") {
      this.state = "lost";
      this.lostAt = now;
    }
    this.retryAt = now + RETRY_MILLIS[Math.min(this.nRetries, RETRY_MILLIS.length - 1)]!;
    this.nRetries += 1;
    this.report();
    if (!this.hasHello) void this.askForRefusal();
  }

  /** Finds out why no WebSocket could be opened, because browsers do not show a server's refusal. */
  private async askForRefusal(): Promise<void> {
    this.refusal = await refusalReason();
    this.report();
  }

  private check(): void {
    const now = performance.now();
    this.checkedAt = now;
    if (!this.socket) {
      if (now >= this.retryAt) this.open();
      else this.report();
      return;
    }
    const silence = now - this.receivedAt;
    const isTrying = this.state === "lost" || this.state === "connecting";
    if (silence > (isTrying ? ATTEMPT_MILLIS : GIVE_UP_MILLIS)) {
      this.disconnect();
    } else if (this.state === "lost") {
      this.report();
    } else if (this.state !== "connecting" && silence > SILENT_MILLIS) {
      this.state = "silent";
      this.report();
    }
    if (now - this.pingedAt >= PING_MILLIS) this.ping();
  }

  private ping(): void {
    this.pingedAt = performance.now();
    this.send({ type: "ping", t: this.pingedAt });
  }

  private report(): void {
    const seconds = (since: number): string => `${Math.max(1, Math.round((performance.now() - since) / 1000))} s`;
    switch (this.state) {
      case "silent":
        this.events.state("silent", `no data from the server for ${seconds(this.receivedAt)}`);
        break;
      case "lost": {
        if (this.refusal) {
          this.events.state("refused", this.refusal);
          break;
        }
        const why = this.goodbye || "connection lost";
        this.events.state("lost", `${why}, reconnecting for ${seconds(this.lostAt)}`);
        break;
      }
      default:
        this.events.state(this.state, this.state === "open" ? `connected to ${location.host}` : "connecting");
    }
  }

  private receive(data: string | ArrayBuffer): void {
    this.receivedAt = performance.now();
    if (this.state === "silent") {
      this.state = "open";
      this.report();
    }
    this.nReceived += typeof data === "string" ? data.length : data.byteLength;
    if (typeof data !== "string") {
      this.receiveBinary(data);
      return;
    }
    const message = JSON.parse(data) as TextMessage;
    switch (message.type) {
      case "hello": {
        this.goodbye = "";
        this.hasStopped = false;
        this.refusal = "";
        this.hasHello = true;
        this.clock.restart();
        const agreement = agree(message, this.topicCapabilities());
        if (typeof agreement === "string") {
          this.goodbye = agreement;
          this.disconnect();
          return;
        }
        this.capabilities = agreement.capabilities;
        if (agreement.hello) this.send(agreement.hello);
        this.nRetries = 0;
        this.state = "open";
        this.report();
        break;
      }
      case "heartbeat":
        this.clock.observeMessage(message.clock_millis);
        break;
      case "pong":
        this.clock.observePong(message.t, message.clock_millis);
        this.roundTripMillis = performance.now() - message.t;
        break;
      case "goodbye":
        this.goodbye = message.reason;
        this.hasStopped = true;
        break;
    }
    this.events.text(message);
  }

  private receiveBinary(data: ArrayBuffer): void {
    const { header, payload } = unframe(data);
    if (header.type !== "part") {
      this.events.binary(header, payload);
      return;
    }
    const joined = this.parts.add(header, payload);
    if (joined) this.receiveBinary(joined);
  }
}
