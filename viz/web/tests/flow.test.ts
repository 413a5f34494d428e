import assert from "node:assert/strict";
import { test } from "node:test";
import { Flow } from "../src/connection/flow";
import { fakeClock } from "./close";

const page = { hidden: false };
Object.assign(globalThis, { document: page });

test("a picture that is awaited for more than 5 s makes the connection slow", (context) => {
  fakeClock(context);
  const flow = new Flow();
  assert.deepEqual([null, 0, 5000, 5001].map((millis) => flow.problem(millis)), ["", "", "", "slow"]);
});

test("live data are missed after 5 s, while the run reads devices", (context) => {
  const now = fakeClock(context);
  const flow = new Flow();
  flow.isReading = true;
  now.millis = 60_000;
  assert.equal(flow.problem(null), "", "nothing has arrived yet, so nothing is expected");
  flow.received("heartbeat");
  flow.received("range_scan");
  now.millis = 70_000;
  assert.equal(flow.problem(null), "", "scans may be hidden");
  flow.received("live_image");
  now.millis = 75_000;
  assert.equal(flow.problem(null), "");
  now.millis = 75_001;
  assert.equal(flow.problem(null), "no live data");
  flow.received("range_scan");
  assert.equal(flow.problem(null), "");
  now.millis = 90_000;
  flow.isReading = false;
  assert.equal(flow.problem(null), "", "the run has ended");
});

test("new connections and hidden pages expect no data until the next ones", (context) => {
  const now = fakeClock(context);
  const flow = new Flow();
  flow.isReading = true;
  flow.received("robot_state");
  flow.restart();
  now.millis = 6000;
  assert.equal(flow.problem(null), "");
  flow.received("robot_state");
  now.millis = 12_000;
  page.hidden = true;
  assert.equal(flow.problem(null), "");
  page.hidden = false;
  assert.equal(flow.problem(null), "");
});
