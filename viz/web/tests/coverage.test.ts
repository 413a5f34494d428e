import assert from "node:assert/strict";
import { test } from "node:test";
import type { ObservationsHeader } from "../src/connection/protocol";
import { directionText, directionTo, type ObservationCodes, placeText, reasonText, worstPlace } from "../src/panels/coverage";
import { assertClose } from "./close";

const CELL_M = 0.05;
const N_CELLS: [number, number, number] = [40, 30, 20];
const SCENE = { center_m: [0, 0, 0.5] as [number, number, number], radius_m: 1 };

function header(isLive: boolean): ObservationsHeader {
  return {
    type: "observations",
    min_m: [-1, -0.75, 0],
    cell_m: CELL_M,
    n_cells: N_CELLS,
    n_keyframes: 10,
    newest_millis: isLive ? 1000 : null,
    min_age_secs: 0.1,
    min_sigma_m: 1e-5,
    log_step: 0.055,
  };
}

/** Cells of the floor from one corner up to the other, with other codes. */
interface Patch {
  from: [number, number];
  to: [number, number];
  age?: number;
  sigma?: number;
}

/** A floor that is seen well, with patches of other codes. */
function floor(isLive: boolean, patches: Patch[]): ObservationCodes {
  const nCells = N_CELLS[0] * N_CELLS[1] * N_CELLS[2];
  const codes = new Uint8Array(2 * nCells);
  for (let y = 0; y < N_CELLS[1]; y++) {
    for (let x = 0; x < N_CELLS[0]; x++) {
      const ix = y * N_CELLS[0] + x;
      const patch = patches.find(({ from, to }) => x >= from[0] && x < to[0] && y >= from[1] && y < to[1]);
      codes[ix] = patch?.age ?? 1;
      codes[nCells + ix] = patch?.sigma ?? 40;
    }
  }
  return { header: header(isLive), codes };
}

test("the largest badly seen place is found, and not a single cell", () => {
  const place = worstPlace(
    floor(false, [
      { from: [28, 12], to: [34, 18], sigma: 180 },
      { from: [10, 10], to: [11, 11], sigma: 255 },
    ]),
    SCENE,
  );
  assert.ok(place);
  // The middle of cells 28 to 33 and 12 to 17.
  assertClose(place.pointM, [-1 + 31 * CELL_M, -0.75 + 15 * CELL_M, 0.5 * CELL_M], CELL_M);
  assertClose([place.sigmaM!], [1e-5 * Math.exp(0.055 * 179)], 1e-9);
  assert.match(reasonText(place, true), /uncertain by 189 mm/);
});

test("a place that is not determined counts more than one that is only uncertain", () => {
  const place = worstPlace(
    floor(false, [
      { from: [10, 10], to: [14, 14], sigma: 255 },
      { from: [28, 12], to: [32, 16], sigma: 150 },
    ]),
    SCENE,
  );
  assert.ok(place);
  assert.equal(place.sigmaM, null);
  assert.match(reasonText(place, false), /too few directions/);
});

test("old places count in live runs only", () => {
  const patch: Patch = { from: [10, 10], to: [16, 16], age: 165 };
  const place = worstPlace(floor(true, [patch]), SCENE);
  assert.ok(place);
  assertClose(place.pointM.slice(0, 2), [-1 + 13 * CELL_M, -0.75 + 13 * CELL_M], CELL_M);
  assert.match(reasonText(place, true), /not seen for 14 min/);
  assert.equal(worstPlace(floor(false, [patch]), SCENE), null);
});

test("places out of reach, and scenes that are seen well, lead to nothing", () => {
  const patch: Patch = { from: [36, 12], to: [40, 16], sigma: 255 };
  assert.ok(worstPlace(floor(true, [patch]), SCENE));
  assert.equal(worstPlace(floor(true, [patch]), { ...SCENE, radius_m: 0.8 }), null);
  assert.equal(worstPlace(floor(true, []), SCENE), null);
  const truncated = floor(true, [patch]);
  assert.equal(worstPlace({ ...truncated, codes: truncated.codes.slice(1) }, SCENE), null);
});

test("a place stays until it is covered or clearly not the worst any more", () => {
  const first: Patch = { from: [28, 12], to: [34, 18], sigma: 160 };
  const other: Patch = { from: [8, 8], to: [14, 14], sigma: 150 };
  const search = (patches: Patch[], found: ReturnType<typeof worstPlace> = null) => worstPlace(floor(false, patches), SCENE, found);
  const found = search([first, other]);
  assert.ok(found && found.pointM[0] > 0);
  // It is seen a little better now, and the other one is the worst.
  const better = { ...first, sigma: 145 };
  assert.ok(search([better, other])!.pointM[0] < 0);
  const kept = search([better, other], found);
  assert.deepEqual([kept!.pointM, kept!.centerM], [found.pointM, found.centerM]);
  assert.ok(kept!.sigmaM! < found.sigmaM!, "its numbers are those of the new map");
  const covered = search([{ ...first, sigma: 90 }, other], found);
  assert.ok(covered!.pointM[0] < 0);
  assert.equal(search([], found), null);
  // Nothing is known of the place in a map of another region.
  assert.ok(search([other], { ...found, centerM: [50, 0, 0], pointM: [50, 0, 0] })!.pointM[0] < 0);
});

test("the text of a place does not depend on the robot", () => {
  assert.equal(placeText([1.24, -0.4, 0.62]), "x 1.2, y -0.4, height 0.6 m");
});

/** A camera at (1, 2, 1) that looks along the world's y axis: its x axis is that of the world. */
const ALONG_Y = [1, 0, 0, 1, 0, 0, 1, 2, 0, -1, 0, 1, 0, 0, 0, 1];
/** The same camera looks down; the upper side of its image points along y. */
const DOWN = [1, 0, 0, 1, 0, -1, 0, 2, 0, 0, -1, 1, 0, 0, 0, 1];

test("directions are relative to the camera", () => {
  const ahead = directionTo([1, 4, 1], ALONG_Y);
  assertClose([ahead.rightRad!, ahead.upM, ahead.distanceM], [0, 0, 2], 1e-9);
  assert.equal(directionText(ahead), "straight ahead, 2.0 m away");
  const right = directionTo([3, 2, 1.6], ALONG_Y);
  assertClose([right.rightRad!], [Math.PI / 2], 1e-9);
  assert.equal(directionText(right), "turn right 90 degrees, 0.6 m higher, 2.1 m away");
  assert.match(directionText(directionTo([-1, 4, 0.5], ALONG_Y)), /^turn left 45 degrees, 0.5 m lower/);
  assert.match(directionText(directionTo([2, 3, 0], DOWN)), /^turn right 45 degrees, 1.0 m lower/);
  // Straight below, there is nothing to turn to.
  assert.equal(directionText(directionTo([1, 2, 0], ALONG_Y)), "1.0 m lower, 1.0 m away");
});
