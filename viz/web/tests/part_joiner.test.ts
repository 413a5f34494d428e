import assert from "node:assert/strict";
import { test } from "node:test";
import { PartJoiner } from "../src/connection/part_joiner";
import type { PartHeader } from "../src/connection/protocol";

function part(message: number, offset: number, bytes: number): PartHeader {
  return { type: "part", message, offset, bytes };
}

test("parts in order give the message once, with the last part", () => {
  const joiner = new PartJoiner();
  assert.equal(joiner.add(part(7, 0, 5), Uint8Array.of(1, 2)), null);
  assert.equal(joiner.add(part(7, 2, 5), Uint8Array.of(3)), null);
  const message = joiner.add(part(7, 3, 5), Uint8Array.of(4, 5));
  assert.deepEqual([...new Uint8Array(message!)], [1, 2, 3, 4, 5]);
  assert.equal(joiner.add(part(7, 3, 5), Uint8Array.of(4, 5)), null);
});

test("a message in a single part is complete", () => {
  const message = new PartJoiner().add(part(1, 0, 2), Uint8Array.of(8, 9));
  assert.deepEqual([...new Uint8Array(message!)], [8, 9]);
});

test("parts of other messages, gaps, and parts beyond the end are ignored", () => {
  const joiner = new PartJoiner();
  joiner.add(part(7, 0, 4), Uint8Array.of(1, 2));
  assert.equal(joiner.add(part(8, 2, 4), Uint8Array.of(3, 4)), null, "another message");
  assert.equal(joiner.add(part(7, 3, 4), Uint8Array.of(4)), null, "a gap");
  assert.equal(joiner.add(part(7, 2, 4), Uint8Array.of(3, 4, 5)), null, "beyond the end");
  const message = joiner.add(part(7, 2, 4), Uint8Array.of(3, 4));
  assert.deepEqual([...new Uint8Array(message!)], [1, 2, 3, 4]);
});

test("a new message replaces an incomplete one, and forget drops it", () => {
  const joiner = new PartJoiner();
  joiner.add(part(1, 0, 4), Uint8Array.of(1, 2));
  joiner.add(part(2, 0, 4), Uint8Array.of(5, 6));
  assert.equal(joiner.add(part(1, 2, 4), Uint8Array.of(3, 4)), null);
  joiner.forget();
  assert.equal(joiner.add(part(2, 2, 4), Uint8Array.of(7, 8)), null);
});

test("no memory is reserved for messages of absurd length", () => {
  const joiner = new PartJoiner();
  for (const bytes of [2 ** 40, Number.NaN]) assert.equal(joiner.add(part(1, 0, bytes), Uint8Array.of(1)), null);
});
