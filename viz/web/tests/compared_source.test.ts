import assert from "node:assert/strict";
import { test } from "node:test";
import { type Source, sourceOf, valueFor } from "../src/panels/compared_source";

test("every source returns from the value of its option", () => {
  const cameras = ["wrist", "stored", "newest", "live:wrist", ""];
  const sources: Source[] = [{ kind: "stored" }, { kind: "newest" }, ...cameras.map((camera) => ({ kind: "live", camera }) as const)];
  for (const source of sources) assert.deepEqual(sourceOf(valueFor(source)), source);
  assert.equal(new Set(sources.map(valueFor)).size, sources.length);
});
