import assert from "node:assert/strict";
import { test } from "node:test";
import { ChunkArrival, type ChunkCounts } from "../src/layers/chunk_arrival";

/** Counts of a model of three chunks, two of which are in view. */
function counts(id: number, numbers: Partial<ChunkCounts>): ChunkCounts {
  return {
    id,
    is_coarse: true,
    n_chunks: 3,
    n_incomplete: 3,
    n_unsent: 0,
    n_incomplete_in_view: 2,
    n_unsent_in_view: 0,
    ...numbers,
  };
}

test("a view is covered when all of its chunks are there, and complete when they are exact", () => {
  const arrival = new ChunkArrival();
  const state = () => [arrival.coversView, arrival.completesView, arrival.hasAll];
  assert.deepEqual(state(), [false, false, false]);
  arrival.add(counts(1, { n_unsent: 2, n_unsent_in_view: 1 }));
  assert.deepEqual(state(), [false, false, false]);
  arrival.add(counts(2, { n_unsent: 1 }));
  assert.deepEqual(state(), [true, false, false]);
  arrival.add(counts(3, {}));
  assert.deepEqual(state(), [true, false, true]);
  arrival.add(counts(1, { n_incomplete: 2, n_incomplete_in_view: 1 }));
  arrival.add(counts(2, { n_incomplete: 1, n_incomplete_in_view: 0 }));
  assert.deepEqual(state(), [true, true, true]);
  assert.deepEqual([arrival.nChunks, arrival.nIncomplete], [3, 1]);
});

test("a view that has turned to missing chunks is no longer covered", () => {
  const arrival = new ChunkArrival();
  arrival.add(counts(1, { n_unsent: 2, n_unsent_in_view: 0 }));
  assert.ok(arrival.coversView);
  arrival.add(counts(2, { n_unsent: 1, n_unsent_in_view: 1 }));
  assert.ok(!arrival.coversView);
  arrival.add(counts(3, {}));
  assert.ok(arrival.coversView);
  // Later, chunks split. Their older versions stay until the new ones are there.
  arrival.add(counts(4, { n_chunks: 5, n_unsent: 1, n_unsent_in_view: 1 }));
  assert.ok(arrival.coversView);
});

test("messages for an earlier subscription do not count what the page has discarded", () => {
  const arrival = new ChunkArrival();
  arrival.add(counts(2, { n_incomplete: 0, n_incomplete_in_view: 0 }));
  assert.ok(!arrival.coversView && !arrival.hasAll);
});

test("servers that do not report on the view are waited for until everything is there", () => {
  const arrival = new ChunkArrival();
  const old = { n_unsent: undefined, n_incomplete_in_view: undefined, n_unsent_in_view: undefined };
  for (const [id, n_incomplete] of [[1, 2], [2, 1]] as const) {
    arrival.add(counts(id, { ...old, n_incomplete }));
    assert.ok(!arrival.coversView);
  }
  arrival.add(counts(3, { ...old, n_incomplete: 0 }));
  assert.ok(arrival.completesView && arrival.hasAll);
});
