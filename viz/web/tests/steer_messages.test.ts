import assert from "node:assert/strict";
import { test } from "node:test";
import { parseMessage } from "../src/steering/messages";
import { ARM, BASE, STATE } from "./steering_examples";

function parsed(message: object): unknown {
  return parseMessage(JSON.stringify(message));
}

test("complete messages are read", () => {
  assert.deepEqual(parsed(ARM), ARM);
  assert.deepEqual(parsed(STATE), STATE);
  const stopped = { ...STATE, stop: "stopped by operator 3", stop_number: 12 };
  assert.deepEqual(parsed(stopped), stopped);
  const refused = { type: "refused", request: "command", text: "grip 2 is used up" };
  assert.deepEqual(parsed(refused), refused);
  const preview = { type: "preview", id: 3, verdict: "never seen", text: "no data", position: null, place: [1, 2, 3] };
  assert.deepEqual(parsed(preview), preview);
  assert.deepEqual(parsed({ type: "pong", id: 1, time_micros: 2.5 }), { type: "pong", id: 1, time_micros: 2.5 });
});

test("a base needs no joints, and damaged parts of it are left out", () => {
  assert.deepEqual(parsed(BASE), BASE);
  assert.equal(parsed({ ...BASE, base: { ...BASE.base, max_yaw_rad_s: "fast" } }), null);
  assert.deepEqual(parsed({ ...BASE, base: { ...BASE.base, area_m: [0, 1] } }), { ...BASE, base: { ...BASE.base, area_m: null } });
  const base = { world_from_base: [1, 2, 3], goal: [4, 5, 6], has_arrived: true, is_moving: false };
  assert.deepEqual(parsed({ ...STATE, position: [], base }), { ...STATE, position: [], base });
  const damaged = parsed({ ...STATE, base: { ...base, goal: [4, null, 6], has_arrived: 1 } }) as typeof STATE;
  assert.deepEqual(damaged.base, { ...base, goal: null, has_arrived: false });
});

test("fields that are missing or new do not matter", () => {
  const { limits: _, clients: __, contacts: ___, ...old } = STATE;
  assert.deepEqual(parsed({ ...old, from_the_future: 1 }), { ...STATE, limits: [], clients: [], contacts: null });
});

test("damaged messages are left out as a whole, and damaged limits one by one", () => {
  const damaged = [
    "",
    "[]",
    "null",
    '{"type":"state"}',
    '{"type":"dance"}',
    JSON.stringify({ ...STATE, base_from_tip: [0, 0, 0, 0, 0, 0] }),
    JSON.stringify({ ...STATE, position: [0, null] }),
    JSON.stringify({ ...ARM, joints: [{ name: "a" }] }),
    JSON.stringify({ ...ARM, joints: [] }),
    JSON.stringify({ type: "preview", id: 1, verdict: "perhaps", text: "" }),
  ];
  for (const text of damaged) assert.equal(parseMessage(text), null, text);
  const limit = { part: "base", link: "clearance", effect: "slowed", speed_scale: 0.5, text: "table", place: [0, 1, 2] };
  const state = parsed({ ...STATE, limits: [limit, { ...limit, effect: "danced" }, null, { ...limit, place: [0, 1] }] });
  assert.deepEqual((state as typeof STATE).limits, [limit, { ...limit, place: null }]);
});

test("a target of another number of joints, and a stop without text, are no target and no stop", () => {
  const state = parsed({ ...STATE, target: [1], stop: 7 }) as typeof STATE;
  assert.equal(state.target, null);
  assert.equal(state.stop, null);
});
