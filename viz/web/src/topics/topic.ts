// The kinds of data that the page receives besides pictures, each of which is a topic.
//
// To add a topic, write a module with a `Topic`, and add it to the list in main.ts. The module has the name of the
// topic, and its messages are in protocol.ts.

import type { Connection } from "../connection/connection";
import type { SubscribeMessage } from "../connection/protocol";

/** A message, or the header of a binary message. */
export interface Typed {
  type: string;
}

export type Payload = Uint8Array<ArrayBuffer>;

/** How often a topic is sent, and its options. A rate of 0 ends the subscription. */
export type Subscription = Omit<SubscribeMessage, "type" | "topic">;

/** What to do with the messages of one type. */
export interface Receiver {
  readonly type: string;
  receive(message: Typed, payload: Payload): void;
}

export interface Topic {
  /** Name in `subscribe`. */
  readonly name: string;
  /** Capability of servers that have the topic. Without one, all servers have it. */
  readonly capability?: string;
  readonly receivers: readonly Receiver[];
  /** What the page needs now. */
  subscriptions(isHidden: boolean): Subscription[];
  /** Forgets the received data, because a new connection sends everything again, with the times of a new clock. */
  restart(isSupported: boolean): void;
}

/** Receives the messages of one type. */
export function on<M extends Typed>(type: M["type"], receive: (message: M, payload: Payload) => void): Receiver {
  return { type, receive: (message, payload) => receive(message as M, payload) };
}

const NO_PAYLOAD = new Uint8Array(0);
/**
 * Subscriptions are sent only after the size of the window has not changed for this time, because
 * image sizes depend on it.
 */
const RESIZE_PAUSE_MILLIS = 200;

export class Topics {
  /** The message sent last for each topic and camera. A message that changes nothing would restart its topic. */
  private readonly sent = new Map<string, string>();
  private readonly receivers = new Map<string, Receiver>();
  private resizeTimer = 0;
  /** Whether a headset shows the data, whatever the browser reports about the page. */
  isPresented = (): boolean => false;

  constructor(
    private readonly connection: Connection,
    private readonly topics: readonly Topic[],
  ) {
    for (const topic of topics) for (const receiver of topic.receivers) this.receivers.set(receiver.type, receiver);
    document.addEventListener("visibilitychange", () => this.update());
    window.addEventListener("resize", () => {
      window.clearTimeout(this.resizeTimer);
      this.resizeTimer = window.setTimeout(() => this.update(), RESIZE_PAUSE_MILLIS);
    });
  }

  /** Capabilities of the topics. */
  get capabilities(): string[] {
    return this.topics.flatMap((topic) => topic.capability ?? []);
  }

  /** Whether the server has a topic. */
  isSupported(topic: Topic): boolean {
    return topic.capability === undefined || this.connection.supportsTopic(topic.capability);
  }

  /** Forgets the received data, and subscribes again, because a new connection has the server's defaults. */
  restart(): void {
    for (const topic of this.topics) topic.restart(this.isSupported(topic));
    this.sent.clear();
    this.update();
  }

  /** Sends the subscriptions that have changed. */
  update(): void {
    if (!this.connection.isOpen || !this.connection.supports("subscribe")) return;
    for (const topic of this.topics) {
      if (!this.isSupported(topic)) continue;
      for (const subscription of topic.subscriptions(document.hidden && !this.isPresented())) {
        const message: SubscribeMessage = { type: "subscribe", topic: topic.name, ...subscription };
        const json = JSON.stringify(message);
        const key = `${topic.name} ${message.camera ?? ""}`;
        if (this.sent.get(key) === json) continue;
        this.sent.set(key, json);
        this.connection.send(message);
      }
    }
  }

  /** Passes a message to its topic. Returns false if it belongs to none. */
  receive(message: Typed, payload: Payload = NO_PAYLOAD): boolean {
    const receiver = this.receivers.get(message.type);
    receiver?.receive(message, payload);
    return receiver !== undefined;
  }
}
