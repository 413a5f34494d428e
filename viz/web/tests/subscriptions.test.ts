import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import type { Connection } from "../src/connection";
import type { LiveImages } from "../src/live_images";
import type { Capability, ClientMessage, SubscribeMessage } from "../src/protocol";
import { Subscriptions } from "../src/subscriptions";

const page = { hidden: false, addEventListener: () => undefined };

beforeEach(() => {
  page.hidden = false;
  Object.assign(globalThis, {
    document: page,
    window: { addEventListener: () => undefined, innerHeight: 600 },
    devicePixelRatio: 1,
  });
});

function setUp(capabilities: Capability[]): {
  subscriptions: Subscriptions;
  resized: Map<string, boolean>;
  sent: () => Record<string, SubscribeMessage>;
} {
  const messages: SubscribeMessage[] = [];
  const resized = new Map<string, boolean>();
  const connection = {
    isOpen: true,
    supports: (capability: Capability) => capabilities.includes(capability),
    send: (message: ClientMessage) => messages.push(message as SubscribeMessage),
  };
  const subscriptions = new Subscriptions(connection as unknown as Connection, { resized } as unknown as LiveImages);
  /** The messages since the last call, by topic and camera. */
  const sent = (): Record<string, SubscribeMessage> =>
    Object.fromEntries(messages.splice(0).map((each) => [each.topic + (each.camera ? ` ${each.camera}` : ""), each]));
  return { subscriptions, resized, sent };
}

test("only topics that the server supports are subscribed, and only once", () => {
  const { subscriptions, sent } = setUp(["subscribe", "robot", "range_scans"]);
  subscriptions.restart();
  const first = sent();
  assert.deepEqual(Object.keys(first).sort(), ["keyframes", "live_images", "range_scans", "robot_state", "status"]);
  assert.equal(first.robot_state!.rate_hz, 60);
  // 22 % of the window's 600 px are 132 px, rounded up to a multiple of 16.
  assert.deepEqual(first.live_images!.size_px, [640, 144]);
  subscriptions.update();
  assert.deepEqual(sent(), {});
  subscriptions.restart();
  assert.equal(Object.keys(sent()).length, 5, "a new connection has the server's defaults");
});

test("servers without subscriptions get none", () => {
  const { subscriptions, sent } = setUp(["robot"]);
  subscriptions.restart();
  assert.deepEqual(sent(), {});
});

test("a change of the page changes one subscription", () => {
  const { subscriptions, sent } = setUp(["subscribe", "range_scans", "keyframe_points", "model_chunks"]);
  subscriptions.restart();
  assert.equal(sent().model_chunks!.rate_hz, 0);
  subscriptions.localModel = "splat";
  assert.deepEqual(sent(), {
    model_chunks: { type: "subscribe", topic: "model_chunks", rate_hz: 1, method: "splat" },
  });
  subscriptions.scans = false;
  assert.deepEqual(sent(), { range_scans: { type: "subscribe", topic: "range_scans", rate_hz: 0 } });
  subscriptions.points = true;
  assert.equal(sent().keyframe_points!.rate_hz, 20);
});

test("an enlarged image is larger than the others, unless images are hidden", () => {
  const { subscriptions, resized, sent } = setUp(["subscribe"]);
  resized.set("wrist", true);
  subscriptions.restart();
  assert.deepEqual(sent()["live_images wrist"]!.size_px, [1280, 960]);
  subscriptions.images = false;
  assert.deepEqual(sent()["live_images wrist"]!.size_px, [16, 16]);
});

test("a hidden page receives only its status, slowly", () => {
  const { subscriptions, resized, sent } = setUp(["subscribe", "robot", "range_scans", "model_chunks"]);
  resized.set("wrist", false);
  subscriptions.restart();
  sent();
  page.hidden = true;
  subscriptions.update();
  const hidden = sent();
  assert.equal(hidden.status!.rate_hz, 0.5);
  const others = ["keyframes", "live_images", "live_images wrist", "robot_state", "range_scans"];
  for (const topic of others) assert.equal(hidden[topic]!.rate_hz, 0, topic);
  page.hidden = false;
  subscriptions.update();
  assert.equal(sent().robot_state!.rate_hz, 60);
});
