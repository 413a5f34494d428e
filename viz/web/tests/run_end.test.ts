import assert from "node:assert/strict";
import { test } from "node:test";
import type { ModelSource, Status } from "../src/connection/protocol";
import { factsOf } from "../src/panels/model_source";
import { stateText, verdictText } from "../src/panels/run_end";

const STATUS: Status = {
  type: "status",
  state: "viewing",
  seconds: 0,
  keyframes: 0,
  rejected: {},
  method: "splat",
  step: 0,
  step_millis: null,
  primitives: 84_512,
  primitives_label: "Splats",
  bytes: 16_000_000,
  has_chunks: true,
  edits: 0,
  psnr: null,
  psnr_history: [],
  others: [],
  edit_revision: 0,
  notes: [],
  result: null,
};
const FILE: ModelSource = {
  kind: "file",
  name: "guitar.ply",
  path: "scans/guitar.ply",
  format: "PLY",
  bytes: 3 * 1024 * 1024,
  modified_unix_secs: null,
  data: null,
  adapter: null,
  verdict: null,
  up_axis: "z",
};

test("the verdict of a run is one sentence, also of older servers", () => {
  const result = { folder: null, scores: "", seconds: 1 };
  assert.equal(verdictText(result), "The run has ended");
  assert.equal(verdictText({ ...result, scores: "PSNR 26.76 dB" }), "The run has ended: PSNR 26.76 dB");
  const verdict = { grade: "good", text: "Good: 31.2 dB on 12 test images" } as const;
  assert.equal(verdictText({ ...result, scores: "PSNR 31.24 dB", verdict }), "Good: 31.2 dB on 12 test images");
});

test("when the program has ended, the page says where its files are", () => {
  assert.doesNotMatch(stateText(false, true), /folder/);
  assert.match(stateText(true, true), /^The program has ended.* Its files are in the folder of the run\.$/);
  assert.doesNotMatch(stateText(true, false), /folder/);
});

test("a file has no facts of a training", () => {
  assert.deepEqual(factsOf(FILE, STATUS), [
    ["File", "scans/guitar.ply"],
    ["Format", "PLY"],
    ["Method", "splat"],
    ["Splats", "84,512"],
    ["Size", "3.1 MB"],
  ]);
});

test("a saved run has the facts of its training", () => {
  const source: ModelSource = { ...FILE, kind: "saved", format: null, data: "scan.mcap", adapter: "llvmpipe" };
  const tsdf = { ...STATUS, method: "tsdf", step: 0, primitives: 12, primitives_label: "Voxel blocks" };
  const facts = factsOf(source, { ...STATUS, seconds: 61.2, step: 1520, others: [tsdf] });
  assert.deepEqual(facts, [
    ["Folder", "scans/guitar.ply"],
    ["Method", "splat, tsdf"],
    ["Splats", "84,512"],
    ["Voxel blocks", "12"],
    ["Size", "3.1 MB"],
    ["Trained for", "61 s"],
    ["Steps", "1,520"],
    ["Data", "scan.mcap"],
    ["Trained on", "llvmpipe"],
  ]);
});
