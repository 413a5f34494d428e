import assert from "node:assert/strict";
import { test } from "node:test";
import { ModeChoice, RoundTrips } from "../src/steering/round_trip";

/** A server whose clock is ahead of the page's by 500 ms. */
function answered(trips: RoundTrips, sentMillis: number, upMillis: number, downMillis: number): void {
  const id = trips.ping(sentMillis);
  trips.pong(id, 1000 * (sentMillis + upMillis + 500), sentMillis + upMillis + downMillis);
}

test("the round-trip time is a median, and unknown before three answers", () => {
  const trips = new RoundTrips();
  answered(trips, 0, 10, 10);
  answered(trips, 100, 10, 10);
  assert.equal(trips.millis(130), null);
  answered(trips, 200, 400, 400);
  assert.equal(trips.millis(1000), 20, "one late answer");
});

test("a ping without an answer counts by its age", () => {
  const trips = new RoundTrips();
  for (let n = 0; n < 5; n++) answered(trips, 100 * n, 5, 5);
  const id = trips.ping(1000);
  assert.equal(trips.millis(1005), 10);
  assert.equal(trips.millis(1300), 300);
  trips.pong(id, 0, 1310);
  assert.equal(trips.millis(1320), 10);
});

test("the server's clock comes from the fastest round trip, and answers of others are ignored", () => {
  const trips = new RoundTrips();
  assert.equal(trips.serverMicros(0), null);
  answered(trips, 0, 300, 10);
  answered(trips, 1000, 4, 4);
  answered(trips, 2000, 10, 200);
  trips.pong(99, 0, 2300);
  assert.equal(trips.serverMicros(3000), 3_500_000);
  trips.restart();
  assert.equal(trips.serverMicros(3000), null);
});

test("old round trips do not count, because clocks drift", () => {
  const trips = new RoundTrips();
  answered(trips, 0, 1, 1);
  answered(trips, 40_000, 30, 10);
  // The middle of the newer one: it is 10 ms off.
  assert.equal(trips.serverMicros(40_000), 40_510_000);
});

test("the mode follows the round-trip time with hysteresis", () => {
  const choice = new ModeChoice();
  assert.equal(choice.update(null, 100, 0), "preview");
  assert.equal(choice.update(90, 100, 0), "servo", "the first measurement decides at once");
  assert.equal(choice.update(101, 100, 10), "preview");
  assert.equal(choice.update(90, 100, 20), "preview");
  assert.equal(choice.update(90, 100, 10_000), "preview", "not short enough");
  assert.equal(choice.update(60, 100, 10_100), "preview");
  assert.equal(choice.update(80, 100, 12_000), "preview", "short for too little time");
  assert.equal(choice.update(60, 100, 13_000), "preview");
  assert.equal(choice.update(60, 100, 15_900), "preview");
  assert.equal(choice.update(60, 100, 16_000), "servo");
  assert.equal(choice.update(95, 100, 16_100), "servo");
});

test("an unknown round-trip time previews", () => {
  const choice = new ModeChoice();
  choice.update(10, 100, 0);
  assert.equal(choice.update(null, 100, 10), "preview");
  assert.equal(choice.update(Number.NaN, 100, 20), "preview");
});
