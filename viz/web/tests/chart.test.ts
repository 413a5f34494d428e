import assert from "node:assert/strict";
import { test } from "node:test";
import { timeText } from "../src/panels/quantities";

test("durations are short texts", () => {
  const texts: [number, string][] = [
    [0, "0 s"],
    [3.14, "3.1 s"],
    [7, "7 s"],
    [42.4, "42 s"],
    [119.4, "119 s"],
    [120, "2 min"],
    [125, "2 min 5 s"],
    [179.7, "3 min"],
    [3599.6, "1 h 0 min"],
    [3600, "1 h 0 min"],
    [7384, "2 h 3 min"],
  ];
  for (const [seconds, text] of texts) assert.equal(timeText(seconds), text, `${seconds} s`);
});
