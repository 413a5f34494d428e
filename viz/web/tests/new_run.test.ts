import assert from "node:assert/strict";
import { test } from "node:test";
import type { Identity, ModelSource } from "../src/connection/protocol";
import { NewRun } from "../src/panels/new_run";

function identity(run: string | null): Identity {
  return { rig: "static-arm", robot: null, run };
}

test("another run is noticed once, and the first one is not another", () => {
  const sentences: string[] = [];
  const newRun = new NewRun((sentence) => sentences.push(sentence));
  newRun.show({});
  newRun.show({ identity: identity(null) });
  newRun.show({ identity: identity("20261129-120000") });
  newRun.show({ identity: identity(null) }); // A program that starts does not know its folder yet.
  newRun.show({ identity: identity("20261129-120000") });
  assert.deepEqual(sentences, []);
  for (let n = 0; n < 2; n += 1) newRun.show({ identity: identity("20261129-151503") });
  newRun.show({ identity: identity("guitar.ply"), source: {} as ModelSource });
  assert.deepEqual(sentences, ["A new run has started: 20261129-151503", "Another model: guitar.ply"]);
});
