import assert from "node:assert/strict";
import { test } from "node:test";
import { type DrawnHeader, labelText, PictureLabel } from "../src/panels/picture_label";

function header(id: number, scale = 1, method = "splat"): DrawnHeader {
  return { id, scale, method, step: 1520, size_px: [Math.round(1000 * scale), Math.round(500 * scale)], sent_millis: 0 };
}

/** Answers the requests of a page in order, and draws them. */
function drawnAt(now: number, ...headers: DrawnHeader[]): PictureLabel {
  const label = new PictureLabel();
  for (const drawn of headers) {
    label.requested(drawn.id, now);
    label.show(drawn, now);
  }
  return label;
}

test("before the first picture, the label shows the time since the first request", () => {
  const label = new PictureLabel();
  assert.deepEqual(label.status(50), { state: "waiting", isOfView: false, waitingMillis: null, isConnected: true, request: null });
  assert.equal(labelText(null, label.status(50), 0, null), "no picture yet");
  label.requested(1, 100);
  label.requested(2, 900);
  assert.equal(labelText(null, label.status(1300), 0, null), "no picture yet · waiting 1.2 s");
});

test("a complete picture of the wanted view stays current, and says what it is", () => {
  const label = drawnAt(0, header(1));
  const status = label.status(60_000);
  assert.deepEqual(status, { state: "current", isOfView: true, waitingMillis: null, isConnected: true, request: 1 });
  assert.equal(labelText(label.header, status, 35.2, null), "splat · 1000 × 500 (100 %) in 35 ms");
  assert.equal(labelText(label.header, status, 35.2, 4000), "splat, 4.0 s old · 1000 × 500 (100 %) in 35 ms");
});

test("from the moment another view is wanted, the picture is not current, and after a second it is old", () => {
  const label = drawnAt(0, header(1));
  label.viewChanged(5000);
  assert.equal(label.status(5000).state, "waiting");
  assert.equal(labelText(label.header, label.status(5000), 35, 5000), "splat, 5.0 s old · waiting");
  label.requested(2, 5010);
  assert.equal(label.status(6000).state, "waiting");
  assert.equal(label.status(6001).state, "old");
  assert.equal(labelText(label.header, label.status(6200), 35, 6200), "splat, 6.2 s old · waiting 1.2 s");
  label.show(header(2, 0.1), 6300);
  assert.deepEqual(label.status(6300), { state: "current", isOfView: true, waitingMillis: 0, isConnected: true, request: 2 });
});

test("without a connection, nothing is awaited, and the age stays", () => {
  const label = drawnAt(0, header(1));
  label.viewChanged(5000);
  label.setConnected(true, 6000);
  assert.equal(label.status(7000).waitingMillis, 2000, "the connection has not changed");
  label.setConnected(false, 8000);
  const lost = label.status(60_000);
  assert.deepEqual([lost.state, lost.waitingMillis, lost.isConnected], ["old", null, false]);
  assert.equal(labelText(label.header, lost, 35, 60_000), "splat, 60 s old · no connection");
  label.setConnected(true, 70_000);
  assert.equal(labelText(label.header, label.status(72_500), 35, 72_500), "splat, 73 s old · waiting 2.5 s");
});

test("a current picture and a missing picture say that there is no connection", () => {
  const label = drawnAt(0, header(1));
  label.setConnected(false, 100);
  const text = labelText(label.header, label.status(9000), 35, 9000);
  assert.equal(text, "splat, 9.0 s old · 1000 × 500 (100 %) in 35 ms · no connection");
  const empty = new PictureLabel();
  empty.requested(1, 0);
  empty.setConnected(false, 100);
  assert.equal(labelText(null, empty.status(9000), 0, null), "no picture yet · no connection");
});

test("a coarse stage that is not followed by a finer one becomes old", () => {
  const label = drawnAt(0, header(1, 0.1));
  assert.equal(label.status(1000).state, "current");
  const late = label.status(1500);
  assert.deepEqual([late.state, late.isOfView], ["old", true]);
  assert.equal(labelText(label.header, late, 35, null), "splat · 100 × 50 (10 %) · waiting 1.5 s");
  label.show(header(1, 0.5), 1600);
  assert.equal(label.status(1700).state, "current");
});

test("pictures of a moving view are not current, and old only if they are late", () => {
  const label = new PictureLabel();
  label.requested(1, 0);
  label.viewChanged(20);
  label.show(header(1, 0.1), 100);
  label.requested(2, 110);
  label.viewChanged(120);
  assert.equal(label.status(200).state, "waiting");
  label.show(header(2, 0.1), 1000);
  assert.equal(label.status(1110).state, "waiting", "it shows the view of 990 ms ago");
  assert.equal(label.status(1130).state, "old");
});

test("a refresh of the same view does not change the state", () => {
  const label = drawnAt(0, header(1));
  label.requested(2, 3000);
  assert.deepEqual([label.status(9000).state, label.status(9000).request], ["current", 2]);
});

test("a picture of another model is old at once, and its late stages are not accepted", () => {
  const label = drawnAt(0, header(1, 0.5, "tsdf"));
  label.modelChanged(100);
  assert.equal(label.status(100).state, "old");
  assert.equal(label.accepts(header(1, 1, "tsdf")), false);
  label.requested(2, 110);
  assert.equal(label.accepts(header(2)), true);
  assert.match(labelText(label.header, label.status(1300), 35, 1300), /^tsdf, 1.3 s old · waiting 1.2 s$/);
  label.show(header(2), 1400);
  assert.deepEqual([label.status(1400).state, label.header?.method], ["current", "splat"]);
});

test("the label of a server that does not name models shows the rest", () => {
  const { method: _, ...unnamed } = header(1);
  const label = drawnAt(0, unnamed);
  assert.equal(labelText(label.header, label.status(0), 8, null), "1000 × 500 (100 %) in 8 ms");
  label.viewChanged(0);
  assert.equal(labelText(label.header, label.status(500), 8, null), "waiting 0.5 s");
});

test("at 1,000 random moments, the state says whether the drawn picture is the wanted one", () => {
  let seed = 7;
  const random = (n: number): number => {
    seed = (Math.imul(seed, 1_664_525) + 1_013_904_223) >>> 0; // Numerical Recipes.
    return Math.floor((seed / 2 ** 32) * n);
  };
  const label = new PictureLabel();
  // The truth: versions of what is wanted, requested and drawn, and the model of each version.
  let wanted = { version: 0, model: "splat" };
  const requests: { id: number; version: number; model: string }[] = [];
  let drawn: (typeof requests)[number] | null = null;
  let scale = 0;
  let now = 0;
  for (let moment = 0; moment < 1000; moment += 1) {
    now += random(400);
    const event = random(6);
    if (event === 0) {
      wanted = { ...wanted, version: wanted.version + 1 };
      label.viewChanged(now);
    } else if (event === 1) {
      wanted = { version: wanted.version + 1, model: wanted.model === "splat" ? "tsdf" : "splat" };
      label.modelChanged(now);
    } else if (event === 2) {
      requests.push({ id: requests.length + 1, ...wanted });
      label.requested(requests.length, now);
    } else {
      // The answer to any request that is not older than the drawn picture, in any stage.
      const possible = requests.filter((request) => request.id >= (drawn?.id ?? 0));
      const answered = possible[random(possible.length)];
      const next = [0.1, 0.5, 1][random(3)]!;
      if (answered && label.accepts(answered)) {
        assert.ok(answered.model === wanted.model || answered.version < wanted.version);
        drawn = answered;
        scale = next;
        label.show(header(answered.id, next, answered.model), now);
      }
    }
    const { state, isOfView } = label.status(now);
    assert.equal(isOfView, drawn !== null && drawn.version === wanted.version, `moment ${moment}`);
    if (state === "current") assert.ok(isOfView);
    if (isOfView && scale === 1) assert.equal(state, "current");
    if (drawn && drawn.model !== wanted.model) assert.equal(state, "old");
    assert.equal(label.header?.method, drawn?.model);
    assert.equal(label.header?.id, drawn?.id);
  }
});
