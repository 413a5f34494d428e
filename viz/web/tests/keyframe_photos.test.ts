import assert from "node:assert/strict";
import { test } from "node:test";
import { KeyframePhotos } from "../src/connection/keyframe_photos";
import type { ClientMessage, KeyframeImageHeader, KeyframeImageMessage, NumberedKeyframe } from "../src/connection/protocol";

function keyframe(id: number): NumberedKeyframe {
  const world_from_camera = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  return { id, stamp_nanos: 10 * id, camera: "wrist", world_from_camera, size_px: [4, 3], focal_px: [2, 2], principal_px: [2, 1.5] };
}

function setUp() {
  const sent: KeyframeImageMessage[] = [];
  const photos = new KeyframePhotos({
    isOpen: true,
    supports: () => true,
    send: (message: ClientMessage) => void sent.push(message as KeyframeImageMessage),
  });
  const answer = ({ id, keyframe }: KeyframeImageMessage, stampNanos = 10 * keyframe): boolean => {
    const header = { type: "keyframe_image", id, keyframe, camera: "wrist", stamp_nanos: stampNanos };
    return photos.receive(header as KeyframeImageHeader, new Uint8Array(0));
  };
  const request = (id: number, isUrgent = false): Promise<number | string> =>
    photos.request(keyframe(id), [64, 48], isUrgent).then(
      ({ header }) => header.keyframe,
      (error: Error) => error.message,
    );
  return { photos, sent, answer, request };
}

test("photographs are requested one at a time, the urgent ones first", async () => {
  const { sent, answer, request } = setUp();
  const promises = [request(1), request(2), request(3, true)];
  assert.deepEqual(sent.map((message) => message.keyframe), [1]);
  assert.deepEqual(sent[0]!.size_px, [64, 48]);
  assert.ok(answer(sent[0]!));
  assert.deepEqual(sent.map((message) => message.keyframe), [1, 3]);
  answer(sent[1]!);
  answer(sent[2]!);
  assert.deepEqual(await Promise.all(promises), [1, 2, 3]);
});

test("errors and other keyframes end a request, and the next one follows", async () => {
  const { photos, sent, answer, request } = setUp();
  const promises = [request(1), request(2), request(3)];
  assert.ok(photos.fail({ type: "error", id: sent[0]!.id, keyframe: 1, message: "not stored" }));
  // A server that was started again has another keyframe with this number.
  answer(sent[1]!, 999);
  answer(sent[2]!);
  assert.deepEqual(await Promise.all(promises), ["not stored", "the list of keyframes has changed", 3]);
  assert.ok(!photos.fail({ type: "error", id: 3, message: "about something else" }));
  assert.ok(!photos.receive({ type: "picture" }, new Uint8Array(0)));
});

test("a new connection ends all requests, and late answers are dropped", async () => {
  const { photos, sent, answer, request } = setUp();
  const promises = [request(1), request(2)];
  photos.restart();
  assert.deepEqual(await Promise.all(promises), Array(2).fill("the connection was interrupted"));
  const next = request(4);
  answer(sent[0]!);
  assert.equal(sent.length, 2);
  answer(sent[1]!);
  assert.equal(await next, 4);
});
