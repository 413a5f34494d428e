import assert from "node:assert/strict";
import { test } from "node:test";
import { freshness } from "../src/layers/freshness";
import { detailsOf, hueOf, iconOf, letterOf, nameOf } from "../src/panels/identity";
import { bytesText, countText, latencyText, stepTimeText } from "../src/panels/quantities";

test("a page is named after the rig, or else the robot or the run", () => {
  const all = { rig: "static-arm", robot: "panda", run: "2026-11-28-kitchen" };
  assert.equal(nameOf(all), "static-arm");
  assert.equal(detailsOf(all), "panda · 2026-11-28-kitchen");
  assert.equal(nameOf({ rig: null, robot: null, run: "guitar.ply" }), "guitar.ply");
  assert.equal(detailsOf({ rig: null, robot: null, run: "guitar.ply" }), "");
  assert.equal(nameOf(undefined), "");
});

test("robots differ by letter or color", () => {
  assert.equal(letterOf("_mobile-arm"), "M");
  assert.equal(letterOf("ärmel"), "Ä");
  assert.equal(letterOf("--"), "");
  const names = ["static-arm", "mobile-arm", "mobile-base", "mobile-base-small", "arm-1", "arm-2", "arm-3"];
  assert.ok(names.every((name) => hueOf(name) >= 0 && hueOf(name) < 360));
  assert.notEqual(hueOf("arm-1"), hueOf("arm-2"));
  assert.notEqual(hueOf("mobile-arm"), hueOf("mobile-base"));
  assert.equal(new Set(["static-arm", "mobile-arm", "mobile-base"].map(iconOf)).size, 3);
});

test("numbers have the units of the terminal", () => {
  assert.equal(bytesText(16_649_000), "16.6 MB");
  assert.equal(bytesText(80_000), "80 kB");
  assert.equal(bytesText(2_340_000_000), "2.34 GB");
  assert.equal(countText(18_343), "18,343");
  assert.deepEqual([null, 0.0123, 41.72, 812.4, 1620, 25_300].map(stepTimeText), [
    "–",
    "0.0123 ms",
    "41.7 ms",
    "812 ms",
    "1.6 s",
    "25 s",
  ]);
});

test("long latencies are in seconds", () => {
  assert.deepEqual([0.4, 812.4, 9999, 53_762].map(latencyText), ["0 ms", "812 ms", "9999 ms", "54 s"]);
});

test("what devices have reported fades with its age", () => {
  assert.equal(freshness(0), 1);
  assert.equal(freshness(1500), 1);
  assert.ok(freshness(3000) < 1 && freshness(3000) > freshness(5000));
  assert.equal(freshness(19_000), 0.2);
  assert.equal(freshness(Infinity), 0.2);
  assert.equal(freshness(Number.NaN), 0.2);
});
