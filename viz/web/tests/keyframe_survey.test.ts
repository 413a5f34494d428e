import assert from "node:assert/strict";
import { test } from "node:test";
import type { NumberedKeyframe } from "../src/connection/protocol";
import type { Comparison } from "../src/panels/keyframe_comparison";
import { keyframeKey } from "../src/panels/keyframe_order";
import { KeyframeSurvey } from "../src/panels/keyframe_survey";

function keyframe(id: number): NumberedKeyframe {
  return { id, stamp_nanos: id, camera: "wrist", world_from_camera: [], size_px: [4, 3], focal_px: [2, 2], principal_px: [2, 1.5] };
}

/** Runs timers and promises until nothing changes. */
async function settle(context: { mock: { timers: { tick(millis: number): void } } }): Promise<void> {
  for (let round = 0; round < 50; round++) {
    for (let turn = 0; turn < 10; turn++) await Promise.resolve();
    context.mock.timers.tick(1000);
  }
}

test("all keyframes are measured once, also if some of them fail", async (context) => {
  // The types are those of Node.js 18, which takes the list itself.
  context.mock.timers.enable({ apis: ["setTimeout"] } as never);
  const all = [keyframe(1), keyframe(2), keyframe(3)];
  const asked: number[] = [];
  const compare = (next: NumberedKeyframe): Promise<Comparison> => {
    asked.push(next.id);
    const hasFailed = next.id === 2;
    const errors = hasFailed ? null : { psnr: 20 + next.id };
    return Promise.resolve({ photo: "", render: hasFailed ? "busy" : {}, newestMillis: null, errors } as Comparison);
  };
  const survey = new KeyframeSurvey({ compare }, () => all, () => undefined);
  await settle(context);
  assert.deepEqual(asked, [], "not before it is wanted");
  survey.enabled = true;
  await settle(context);
  assert.deepEqual(asked, [1, 2, 2, 2, 3]);
  assert.deepEqual(all.map((each) => survey.psnrOf.get(keyframeKey(each))), [21, Infinity, 23]);
  assert.equal(survey.nMeasured, 3);
  survey.forget();
  survey.enabled = false;
  survey.enabled = true;
  await settle(context);
  assert.equal(survey.nMeasured, 3, "measured again for another model");
  all.push(keyframe(4));
  survey.enabled = false;
  await settle(context);
  assert.equal(survey.nMeasured, 3);
});
