import assert from "node:assert/strict";
import { test } from "node:test";
import { avoidanceText, baseGoalText, baseText, leaseText, stopText } from "../src/steering/texts";
import { STATE } from "./steering_examples";

test("a stop is shown also while the arm is being recovered", () => {
  assert.equal(stopText(STATE), "");
  const stop = "the arm stopped: a motor is too hot; since then: stopped by operator 2";
  assert.equal(stopText({ ...STATE, stop }), `The arm is stopped: ${stop}`);
  const recovering = stopText({ ...STATE, stop, is_recovering: true });
  assert.match(recovering, /being recovered/);
  assert.match(recovering, /stopped by operator 2/);
  assert.match(stopText({ ...STATE, is_recovering: true }), /being recovered\. .*stops it\.$/);
});

test("texts name the base if it is steered", () => {
  const base = { world_from_base: null, goal: null, has_arrived: false, is_moving: false };
  assert.equal(stopText({ ...STATE, stop: "bumper", base, position: [] }), "The base is stopped: bumper");
  assert.equal(stopText({ ...STATE, stop: "bumper", base }), "The robot is stopped: bumper");
  assert.equal(leaseText({ ...STATE, holder: 3, moved_part: "base" }, 7), "Operator 3 has control and moves the base for at least 5 s more");
  assert.match(avoidanceText("seen_surfaces"), /enters space that nothing has seen/);
  assert.match(avoidanceText("nothing"), /Nothing but you/);
  assert.equal(leaseText({ ...STATE, holder: null }, 7, "base"), "Nobody has control of the base");
  assert.equal(baseText(12.4), "The base moves while you hold (12 ms)");
  assert.equal(baseGoalText(false, false), "The goal is outside the area of the base");
  assert.equal(baseGoalText(true, true), "The base is at the goal");
});
