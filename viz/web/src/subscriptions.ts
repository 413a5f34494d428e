// Subscribes to the data that the page shows, at the rates and sizes at which it is shown.

import type { Connection } from "./connection";
import type { LiveImages } from "./live_images";
import type { SubscribeMessage } from "./protocol";

const STATUS_HZ = 2;
const KEYFRAMES_HZ = 2;
/** An image is labeled live for half a second. */
const IMAGES_HZ = 4;
const ROBOT_HZ = 60;
/** Keyframes whose points are sent per second, 22 kB each. */
const POINTS_HZ = 20;
/** Scans are sent this often, 36 kB each. */
const SCANS_HZ = 2;
const BASE_PATH_HZ = 1;
/** Maps of observations per second, while they are shown; about 30 kB each. */
const OBSERVATIONS_HZ = 0.5;
/** Versions of the model per second, if the page draws it. */
const CHUNKS_HZ = 1;
/** Rate of the status, which the title bar needs, while the page is hidden. */
const HIDDEN_STATUS_HZ = 0.5;
/** Limits of the height of camera images, in CSS pixels: see `.live canvas` in app.css. */
const IMAGE_HEIGHT = { min: 90, max: 190, ofWindow: 0.22 };
const MAX_IMAGE_WIDTH_PX = 640;
/** Maximum size of images that are enlarged or fill the view. */
const ENLARGED_PX: [number, number] = [1280, 960];
/** The server rounds image sizes down to multiples of this. */
const IMAGE_STEP_PX = 16;
/** While the window is being resized, image sizes are not sent. */
const RESIZE_PAUSE_MILLIS = 200;

export class Subscriptions {
  /** The message sent last for each topic and camera. A message that changes nothing would restart its topic. */
  private readonly sent = new Map<string, string>();
  private resizeTimer = 0;
  private showsPoints = false;
  private showsScans = true;
  private showsObservations = false;
  private showsLargeImages = false;
  private drawnMethod: string | null = null;

  private showsImages = true;

  constructor(
    private readonly connection: Connection,
    private readonly liveImages: LiveImages,
  ) {
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

  /** Whether the camera images fill the view. */
  set largeImages(shown: boolean) {
    this.showsLargeImages = shown;
    this.update();
  }

  /** Whether range scans are shown. */
  set scans(shown: boolean) {
    this.showsScans = shown;
    this.update();
  }

  /** Whether the model is tinted by its observations. */
  set observations(shown: boolean) {
    this.showsObservations = shown;
    this.update();
  }

  /** Whether camera images are shown. Otherwise, they are small: their poses are still needed. */
  set images(shown: boolean) {
    this.showsImages = shown;
    this.update();
  }

  /** The model that the page draws; null if the server draws it. */
  set localModel(method: string | null) {
    this.drawnMethod = method;
    this.update();
  }

  /** Sends the subscriptions that have changed. */
  update(): void {
    if (!this.connection.isOpen || !this.connection.supports("subscribe")) return;
    for (const message of document.hidden ? this.whileHidden() : this.whileVisible()) {
      const json = JSON.stringify(message);
      const key = `${message.topic} ${message.camera ?? ""}`;
      if (this.sent.get(key) === json) continue;
      this.sent.set(key, json);
      this.connection.send(message);
    }
  }

  private whileVisible(): SubscribeMessage[] {
    const images = { type: "subscribe", topic: "live_images", rate_hz: IMAGES_HZ } as const;
    const messages: SubscribeMessage[] = [
      { type: "subscribe", topic: "status", rate_hz: STATUS_HZ },
      { type: "subscribe", topic: "keyframes", rate_hz: KEYFRAMES_HZ },
      { ...images, size_px: this.showsLargeImages ? ENLARGED_PX : this.thumbnailPx() },
    ];
    for (const [camera, isEnlarged] of this.liveImages.resized) {
      const isLarge = (isEnlarged && this.showsImages) || this.showsLargeImages;
      messages.push({ ...images, camera, size_px: isLarge ? ENLARGED_PX : this.thumbnailPx() });
    }
    if (this.connection.supports("robot")) {
      messages.push({ type: "subscribe", topic: "robot_state", rate_hz: ROBOT_HZ });
    }
    const layers = [
      ["keyframe_points", this.showsPoints ? POINTS_HZ : 0],
      ["range_scans", this.showsScans ? SCANS_HZ : 0],
      ["base_path", BASE_PATH_HZ],
      ["observations", this.showsObservations ? OBSERVATIONS_HZ : 0],
    ] as const;
    for (const [topic, rate_hz] of layers) {
      if (this.connection.supports(topic)) messages.push({ type: "subscribe", topic, rate_hz });
    }
    if (this.connection.supports("model_chunks")) {
      const chunks = { type: "subscribe", topic: "model_chunks" } as const;
      messages.push(
        this.drawnMethod ? { ...chunks, rate_hz: CHUNKS_HZ, method: this.drawnMethod } : { ...chunks, rate_hz: 0 },
      );
    }
    return messages;
  }

  private thumbnailPx(): [number, number] {
    if (!this.showsImages) return [IMAGE_STEP_PX, IMAGE_STEP_PX];
    const { min, max, ofWindow } = IMAGE_HEIGHT;
    const height = Math.min(max, Math.max(min, ofWindow * window.innerHeight)) * Math.min(devicePixelRatio, 2);
    return [MAX_IMAGE_WIDTH_PX, IMAGE_STEP_PX * Math.ceil(height / IMAGE_STEP_PX)];
  }

  private whileHidden(): SubscribeMessage[] {
    const messages: SubscribeMessage[] = [
      { type: "subscribe", topic: "status", rate_hz: HIDDEN_STATUS_HZ },
      { type: "subscribe", topic: "keyframes", rate_hz: 0 },
      { type: "subscribe", topic: "live_images", rate_hz: 0 },
    ];
    for (const camera of this.liveImages.resized.keys()) {
      messages.push({ type: "subscribe", topic: "live_images", camera, rate_hz: 0 });
    }
    if (this.connection.supports("robot")) messages.push({ type: "subscribe", topic: "robot_state", rate_hz: 0 });
    for (const topic of ["keyframe_points", "range_scans", "base_path", "observations", "model_chunks"] as const) {
      if (this.connection.supports(topic)) messages.push({ type: "subscribe", topic, rate_hz: 0 });
    }
    return messages;
  }
}
