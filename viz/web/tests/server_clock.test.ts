import assert from "node:assert/strict";
import { test } from "node:test";
import { ServerClock } from "../src/connection/server_clock";
import { fakeClock } from "./close";

test("nothing is known before the first answer", (context) => {
  fakeClock(context);
  const clock = new ServerClock();
  clock.observeMessage(5000);
  assert.deepEqual([clock.serverMillis(0), clock.ageOf(5000)()], [null, null]);
});

test("the fastest answer gives the bound", (context) => {
  const now = fakeClock(context);
  const clock = new ServerClock();
  // The server is ahead by at most 5000 ms, then by at most 4950 ms.
  now.millis = 180;
  clock.observePong(100, 5100);
  assert.equal(clock.serverMillis(200), 5200);
  now.millis = 310;
  clock.observePong(300, 5250);
  assert.equal(clock.serverMillis(200), 5150);
  now.millis = 400;
  assert.equal(clock.ageOf(5000)(), 350);
});

test("samples that contradict a message are dropped", (context) => {
  const now = fakeClock(context);
  const clock = new ServerClock();
  clock.observePong(100, 5100);
  clock.observePong(300, 5250);
  now.millis = 400;
  clock.observeMessage(5370); // Ahead by at least 4970 ms.
  assert.equal(clock.serverMillis(0), 5000);
});

test("events of an old server keep their ages, and those of a new server have none before its first answer", (context) => {
  const now = fakeClock(context);
  const clock = new ServerClock();
  clock.observePong(100, 5100);
  const old = clock.ageOf(5000);
  now.millis = 400;
  assert.equal(old(), 400);
  clock.restart();
  const recent = clock.ageOf(90);
  assert.deepEqual([old(), recent()], [400, null]);
  now.millis = 60_000;
  clock.observePong(60_000, 100);
  now.millis = 60_500;
  assert.deepEqual([old(), recent()], [60_500, 510]);
});

test("samples expire after 30 s, and forget drops all", (context) => {
  const now = fakeClock(context);
  const clock = new ServerClock();
  clock.observePong(0, 1000);
  now.millis = 29_999;
  clock.observePong(29_999, 32_000);
  assert.equal(clock.serverMillis(0), 1000);
  now.millis = 30_001;
  clock.observePong(30_001, 32_002);
  assert.equal(clock.serverMillis(0), 2001);
  clock.forget();
  assert.equal(clock.serverMillis(0), null);
});
