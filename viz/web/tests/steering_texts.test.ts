import assert from "node:assert/strict";
import { test } from "node:test";
import { stopText } from "../src/steering/texts";
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
