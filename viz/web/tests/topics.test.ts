import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import type { Connection } from "../src/connection/connection";
import type { LiveImages } from "../src/panels/live_images";
import type { OrbitView } from "../src/view/orbit_view";
import type { ClientMessage, SubscribeMessage } from "../src/connection/protocol";
import { KeyframePointsTopic } from "../src/topics/keyframe_points";
import { LiveImagesTopic } from "../src/topics/live_images";
import { ModelChunksTopic } from "../src/topics/model_chunks";
import { RangeScansTopic } from "../src/topics/range_scans";
import { statusTopic } from "../src/topics/status";
import { on, type Topic, Topics, type Typed } from "../src/topics/topic";

const page = { hidden: false, addEventListener: () => undefined, getElementById: () => ({ hidden: false }) };

beforeEach(() => {
  page.hidden = false;
  Object.assign(globalThis, {
    document: page,
    window: { addEventListener: () => undefined, innerHeight: 600 },
    devicePixelRatio: 1,
    HTMLElement: Object,
    HTMLButtonElement: Object,
  });
});

function setUp(capabilities: string[], extra: Topic[] = []) {
  const messages: SubscribeMessage[] = [];
  const connection = {
    isOpen: true,
    supports: (capability: string) => capabilities.includes(capability),
    supportsTopic: (capability: string) => capabilities.includes(capability),
    send: (message: ClientMessage) => messages.push(message as SubscribeMessage),
  };
  const layer = { clear: () => undefined, renew: () => undefined };
  const attachment = { forgetCameras: () => undefined };
  const view = { overlays: { forgetLive: () => undefined }, attachment, scans: layer, points: layer, local: layer };
  const images = { resized: new Map<string, boolean>() };
  const changed = (): void => topics.update();
  const given = <T>(value: unknown): T => value as T;
  const liveImages = new LiveImagesTopic(given<OrbitView>(view), given<LiveImages>(images), changed);
  const [scans, points, chunks] = [
    new RangeScansTopic(given<OrbitView>(view), changed),
    new KeyframePointsTopic(given<OrbitView>(view), changed),
    new ModelChunksTopic(given<OrbitView>(view), changed),
  ];
  const table: Topic[] = [statusTopic(() => undefined), liveImages, scans, points, chunks, ...extra];
  const topics = new Topics(given<Connection>(connection), table);
  /** The messages since the last call, by topic and camera. */
  const sent = (): Record<string, SubscribeMessage> =>
    Object.fromEntries(messages.splice(0).map((each) => [each.topic + (each.camera ? ` ${each.camera}` : ""), each]));
  return { topics, liveImages, scans, points, chunks, resized: images.resized, sent };
}

test("only topics that the server supports are subscribed, and only once", () => {
  const { topics, sent } = setUp(["subscribe", "range_scans"]);
  topics.restart();
  const first = sent();
  assert.deepEqual(Object.keys(first).sort(), ["live_images", "range_scans", "status"]);
  assert.equal(first.status!.rate_hz, 2);
  // 22 % of the window's 600 px are 132 px, rounded up to a multiple of 16.
  assert.deepEqual(first.live_images!.size_px, [640, 144]);
  topics.update();
  assert.deepEqual(sent(), {});
  topics.restart();
  assert.equal(Object.keys(sent()).length, 3, "a new connection has the server's defaults");
});

test("servers without subscriptions get none", () => {
  const { topics, sent } = setUp(["range_scans"]);
  topics.restart();
  assert.deepEqual(sent(), {});
});

test("a change of the page changes one subscription", () => {
  const { topics, scans, points, chunks, sent } = setUp([
    "subscribe",
    "range_scans",
    "keyframe_points",
    "model_chunks",
  ]);
  topics.restart();
  assert.equal(sent().model_chunks!.rate_hz, 0);
  chunks.method = "splat";
  assert.deepEqual(sent(), {
    model_chunks: { type: "subscribe", topic: "model_chunks", rate_hz: 1, method: "splat" },
  });
  scans.shown = false;
  assert.deepEqual(sent(), { range_scans: { type: "subscribe", topic: "range_scans", rate_hz: 0 } });
  points.shown = true;
  assert.equal(sent().keyframe_points!.rate_hz, 20);
});

test("an enlarged image is larger than the others, unless images are hidden", () => {
  const { topics, liveImages, resized, sent } = setUp(["subscribe"]);
  resized.set("wrist", true);
  topics.restart();
  assert.deepEqual(sent()["live_images wrist"]!.size_px, [1280, 960]);
  liveImages.shown = false;
  assert.deepEqual(sent()["live_images wrist"]!.size_px, [16, 16]);
});

test("a hidden page gets the status at a low rate, and nothing else", () => {
  const { topics, resized, sent } = setUp(["subscribe", "range_scans"]);
  resized.set("wrist", false);
  page.hidden = true;
  topics.restart();
  const rates = Object.entries(sent()).map(([topic, { rate_hz }]) => [topic, rate_hz]);
  assert.deepEqual(Object.fromEntries(rates), {
    status: 0.5,
    live_images: 0,
    "live_images wrist": 0,
    range_scans: 0,
  });
});

test("a new topic needs one module", () => {
  interface Weather extends Typed {
    type: "weather";
    celsius: number;
  }
  const received: number[] = [];
  const weather: Topic = {
    name: "weather",
    receivers: [on<Weather>("weather", (message) => received.push(message.celsius))],
    subscriptions: () => [{ rate_hz: 5 }],
    restart: () => received.splice(0),
  };
  const { topics, sent } = setUp(["subscribe"], [weather]);
  topics.restart();
  assert.equal(sent().weather!.rate_hz, 5);
  const message: Weather = { type: "weather", celsius: 20.5 };
  assert.ok(topics.receive(message) && !topics.receive({ type: "tides" }));
  assert.deepEqual(received, [20.5]);
  topics.restart();
  assert.deepEqual(received, []);
});
