import assert from "node:assert/strict";
import { type TestContext, test } from "node:test";
import type { Connection } from "../src/connection/connection";
import type { ClientMessage, PictureHeader, RenderMessage } from "../src/connection/protocol";
import { RenderScheduler, type View } from "../src/connection/render_scheduler";
import { fakeClock } from "./close";

const VIEW: View = {
  world_from_camera: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
  size_px: [640, 480],
  projection: { kind: "pinhole", focal_px: [500, 500], principal_px: [320, 240] },
  near_m: 0.1,
  far_m: 100,
  crop: undefined,
};

/** A scheduler whose requests are collected, and its clock. */
function setUp(context: TestContext): {
  scheduler: RenderScheduler;
  requests: RenderMessage[];
  clock: { millis: number };
  answer: (afterMillis: number) => void;
} {
  const clock = fakeClock(context);
  const requests: RenderMessage[] = [];
  const connection = {
    isOpen: true,
    supports: () => true,
    send: (message: ClientMessage) => requests.push(message as RenderMessage),
  };
  const scheduler = new RenderScheduler(
    connection as unknown as Connection,
    () => VIEW,
    () => [0.25, 0.5, 1],
    [0, 0, 0],
    () => "splat",
  );
  const answer = (afterMillis: number): void => {
    const { id, stages } = requests.at(-1)!;
    clock.millis += afterMillis;
    scheduler.answered({ id, last: true, scale: stages.at(-1)! } as PictureHeader);
  };
  return { scheduler, requests, clock, answer };
}

test("while the view moves, one small picture is requested at a time", (context) => {
  const { scheduler, requests, answer } = setUp(context);
  scheduler.moved();
  scheduler.tick();
  scheduler.tick();
  assert.equal(requests.length, 1);
  assert.deepEqual(requests[0]!.stages, [0.1]);
  assert.deepEqual(requests[0]!.outputs, ["color", "depth"]);
  assert.deepEqual([requests[0]!.method, requests[0]!.depth_format], ["splat", "compact_half"]);
  answer(50);
  scheduler.moved();
  scheduler.tick();
  assert.equal(requests.length, 2);
});

test("pictures of the moving view grow while answers are fast, and shrink when they are slow", (context) => {
  const { scheduler, requests, answer } = setUp(context);
  const scales = [20, 20, 20, 50, 150, 150, 150, 150].map((millis) => {
    scheduler.moved();
    scheduler.tick();
    answer(millis);
    return requests.at(-1)!.stages[0]!;
  });
  assert.deepEqual(scales, [0.1, 0.15, 0.25, 0.35, 0.35, 0.25, 0.15, 0.1]);
});

test("at rest, only stages that are finer than the last picture are requested", (context) => {
  const { scheduler, requests, clock, answer } = setUp(context);
  for (const millis of [20, 20, 20]) {
    scheduler.moved();
    scheduler.tick();
    answer(millis);
  }
  clock.millis += 160;
  scheduler.tick();
  assert.deepEqual(requests.at(-1)!.stages, [0.35], "180 ms after the last motion, the view still counts as moving");
  answer(0);
  clock.millis += 1;
  scheduler.tick();
  assert.deepEqual(requests.at(-1)!.stages, [0.5, 1]);
});

test("a view at rest is refreshed after a change, with pauses", (context) => {
  const { scheduler, requests, clock, answer } = setUp(context);
  scheduler.tick();
  answer(100);
  clock.millis += 10_000;
  scheduler.tick();
  assert.equal(requests.length, 1, "nothing has changed");
  scheduler.modelChanged();
  scheduler.tick();
  assert.deepEqual(requests.at(-1)!.stages, [1]);
  answer(100);
  // A quarter of the time may be spent on refreshes, so that a pause takes three times as long.
  scheduler.modelChanged();
  clock.millis += 299;
  scheduler.tick();
  assert.equal(requests.length, 2);
  clock.millis += 2;
  scheduler.tick();
  assert.equal(requests.length, 3);
});

test("a view at rest is refreshed continuously where its user wants it", (context) => {
  const { scheduler, requests, clock, answer } = setUp(context);
  scheduler.isContinuous = true;
  scheduler.tick();
  answer(100);
  for (const n of [2, 3, 4]) {
    scheduler.modelChanged();
    clock.millis += 1;
    scheduler.tick();
    assert.equal(requests.length, n, "as soon as the previous picture has arrived");
    scheduler.tick();
    assert.equal(requests.length, n, "one at a time");
    answer(100);
  }
});

test("a request without an answer is repeated after a timeout, or when it has failed", (context) => {
  const { scheduler, requests, clock } = setUp(context);
  const move = (): void => {
    scheduler.moved();
    scheduler.tick();
  };
  move();
  clock.millis = 2999;
  move();
  assert.equal(requests.length, 1);
  clock.millis = 3001;
  move();
  assert.equal(requests.length, 2);
  scheduler.failed(requests[0]!.id);
  move();
  assert.equal(requests.length, 2, "an older request has failed");
  scheduler.failed(requests[1]!.id);
  move();
  assert.equal(requests.length, 3);
});

test("an observer follows every change of what is wanted, and every request", (context) => {
  const clock = fakeClock(context);
  const events: (number | "changed")[] = [];
  const connection = { isOpen: true, supports: () => true, send: () => undefined };
  const scheduler = new RenderScheduler(
    connection as unknown as Connection,
    () => VIEW,
    () => [0.25, 1],
    [0, 0, 0],
    () => "splat",
    { viewChanged: () => events.push("changed"), requested: (id) => events.push(id) },
  );
  scheduler.moved();
  scheduler.tick();
  clock.millis = 200;
  scheduler.tick();
  scheduler.answered({ id: 2, last: true, scale: 1 } as PictureHeader);
  scheduler.modelChanged();
  clock.millis = 10_000;
  scheduler.tick();
  assert.deepEqual(events, ["changed", 1, 2, 3], "a refresh shows the same view");
  scheduler.restart();
  assert.deepEqual(events.slice(4), ["changed"]);
});

test("a page that draws the model itself requests only the depth of the resting view", (context) => {
  const { scheduler, requests, clock } = setUp(context);
  scheduler.drawsLocally = true;
  scheduler.moved();
  scheduler.tick();
  assert.equal(requests.length, 0);
  clock.millis = 181;
  scheduler.tick();
  assert.equal(requests.length, 1);
  assert.deepEqual([requests[0]!.stages, requests[0]!.outputs], [[1], ["depth"]]);
});
