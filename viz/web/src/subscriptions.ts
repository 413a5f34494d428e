// Subscribes to the data that the page shows, at the rates and sizes at which it is shown.

import type { Connection } from "./connection";
import type { SubscribeMessage } from "./protocol";

const STATUS_HZ = 2;
const KEYFRAMES_HZ = 2;
/** An image is labeled live for half a second. */
const IMAGES_HZ = 4;
const ROBOT_HZ = 60;
/** Keyframes whose points are sent per second, 22 kB each. */
const POINTS_HZ = 20;
/** Versions of the model per second, if the page draws it. */
const CHUNKS_HZ = 1;
/** Rate of the status, which the title bar needs, while the page is hidden. */
const HIDDEN_STATUS_HZ = 0.5;
/** Limits of the height of camera images, in CSS pixels: see `.live canvas` in app.css. */
const IMAGE_HEIGHT = { min: 90, max: 190, ofWindow: 0.22 };
const MAX_IMAGE_WIDTH_PX = 640;
/** The server rounds image sizes down to multiples of this. */
const IMAGE_STEP_PX = 16;
/** While the window is being resized, image sizes are not sent. */
const RESIZE_PAUSE_MILLIS = 200;

export class Subscriptions {
  /** The message sent last for each topic. A message that changes nothing would restart its topic. */
  private readonly sent = new Map<SubscribeMessage["topic"], string>();
  private resizeTimer = 0;
  private showsPoints = false;
  private drawnMethod: string | null = null;

  constructor(private readonly connection: Connection) {
    document.addEventListener("visibilitychange", () => this.update());
    window.addEventListener("resize", () => {
      window.clearTimeout(this.resizeTimer);
      this.resizeTimer = window.setTimeout(() => this.update(), RESIZE_PAUSE_MILLIS);
    });
  }

  /** Subscribes anew: a new connection has the server's defaults. */
  restart(): void {
    this.sent.clear();
    this.update();
  }

  /** Whether the points of keyframes are shown. */
  set points(shown: boolean) {
    this.showsPoints = shown;
    this.update();
  }

  /** The model that the page draws; null if the server draws it. */
  set localModel(method: string | null) {
    this.drawnMethod = method;
    this.update();
  }

  private update(): void {
    if (!this.connection.isOpen || !this.connection.supports("subscribe")) return;
    for (const message of document.hidden ? this.whileHidden() : this.whileVisible()) {
      const json = JSON.stringify(message);
      if (this.sent.get(message.topic) === json) continue;
      this.sent.set(message.topic, json);
      this.connection.send(message);
    }
  }

  private whileVisible(): SubscribeMessage[] {
    const { min, max, ofWindow } = IMAGE_HEIGHT;
    const height = Math.min(max, Math.max(min, ofWindow * window.innerHeight)) * Math.min(devicePixelRatio, 2);
    const messages: SubscribeMessage[] = [
      { type: "subscribe", topic: "status", rate_hz: STATUS_HZ },
      { type: "subscribe", topic: "keyframes", rate_hz: KEYFRAMES_HZ },
      {
        type: "subscribe",
        topic: "live_images",
        rate_hz: IMAGES_HZ,
        size_px: [MAX_IMAGE_WIDTH_PX, IMAGE_STEP_PX * Math.ceil(height / IMAGE_STEP_PX)],
      },
    ];
    if (this.connection.supports("robot")) {
      messages.push({ type: "subscribe", topic: "robot_state", rate_hz: ROBOT_HZ });
    }
    if (this.connection.supports("keyframe_points")) {
      messages.push({ type: "subscribe", topic: "keyframe_points", rate_hz: this.showsPoints ? POINTS_HZ : 0 });
    }
    if (this.connection.supports("model_chunks")) {
      const chunks = { type: "subscribe", topic: "model_chunks" } as const;
      messages.push(
        this.drawnMethod ? { ...chunks, rate_hz: CHUNKS_HZ, method: this.drawnMethod } : { ...chunks, rate_hz: 0 },
      );
    }
    return messages;
  }

  private whileHidden(): SubscribeMessage[] {
    const messages: SubscribeMessage[] = [
      { type: "subscribe", topic: "status", rate_hz: HIDDEN_STATUS_HZ },
      { type: "subscribe", topic: "keyframes", rate_hz: 0 },
      { type: "subscribe", topic: "live_images", rate_hz: 0 },
    ];
    const optional = [
      ["robot", "robot_state"],
      ["keyframe_points", "keyframe_points"],
      ["model_chunks", "model_chunks"],
    ] as const;
    for (const [capability, topic] of optional) {
      if (this.connection.supports(capability)) messages.push({ type: "subscribe", topic, rate_hz: 0 });
    }
    return messages;
  }
}
