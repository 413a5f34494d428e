import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { LocalModel } from "../src/layers/local_model";
import type { ObservationLayer } from "../src/layers/observation_layer";
import type { SplatChunkHeader } from "../src/connection/protocol";
import type { View } from "../src/connection/render_scheduler";
import { type FreeUnits, type SetChunk, type Sort, SplatSorter } from "../src/layers/splat_sorter";

const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
const VIEW: View = {
  world_from_camera: IDENTITY,
  size_px: [64, 48],
  projection: { kind: "pinhole", focal_px: [50, 50], principal_px: [32, 24] },
  near_m: 0.1,
  far_m: 100,
  crop: undefined,
};

/** Workers whose answers arrive when `answerWorkers` is called. */
const answers: (() => void)[] = [];
class FakeWorker {
  onmessage: ((event: { data: { order: Uint32Array } }) => void) | null = null;
  private readonly sorter = new SplatSorter();

  postMessage(message: SetChunk | FreeUnits | Sort): void {
    if (message.kind === "set") this.sorter.set(message);
    else if (message.kind === "free") this.sorter.free(message);
    else {
      const order = this.sorter.sort(message);
      answers.push(() => this.onmessage?.({ data: { order } }));
    }
  }

  terminate(): void {
    this.onmessage = null;
  }
}

function answerWorkers(): void {
  for (const answer of answers.splice(0)) answer();
}

beforeEach(() => {
  answers.length = 0;
  Object.assign(globalThis, { Worker: FakeWorker });
});

/** A chunk of one splat in front of the camera; two chunks are a model, and both are in view. */
function chunk(method: string, id: number, nIncomplete: number, nUnsent = 0): SplatChunkHeader {
  return {
    type: "model_chunk",
    method,
    id,
    is_coarse: nIncomplete > 0,
    n_chunks: 2,
    n_incomplete: nIncomplete,
    n_unsent: nUnsent,
    n_incomplete_in_view: nIncomplete,
    n_unsent_in_view: nUnsent,
    world_from_model: IDENTITY,
    kind: "splats",
    n_splats: 1,
    min_m: [0, 0, 1],
    max_m: [1, 1, 2],
    log_scale_range: [-4, -2],
    scale_factor: 1,
    sh_degree: 0,
    sh_ranges: [0, 0],
    is_antialiased: false,
  };
}

function setUp() {
  const model = new LocalModel({ uniforms: {} } as unknown as ObservationLayer, () => undefined);
  /** Draws like the view; returns the drawn method. */
  const draw = (hasPicture = true): string | null => {
    model.root.visible = true;
    model.setView(VIEW, [64, 48], hasPicture);
    return model.drawn?.method ?? null;
  };
  const receive = async (...headers: SplatChunkHeader[]): Promise<void> => {
    for (const header of headers) model.receive(header, new Uint8Array(16));
    await new Promise((done) => setTimeout(done, 0)); // Chunks are decoded in promises.
  };
  /** Draws until splats are sorted. */
  const drawSorted = (hasPicture = true): string | null => {
    draw(hasPicture);
    answerWorkers();
    return draw(hasPicture);
  };
  return { model, draw, drawSorted, receive };
}

/** All messages of a model that is sent completely. */
function complete(method: string): SplatChunkHeader[] {
  return [chunk(method, 1, 2, 1), chunk(method, 2, 2), chunk(method, 1, 1), chunk(method, 2, 0)];
}

test("the server's picture stays until the chunks in view are there and sorted", async () => {
  const { model, draw, drawSorted, receive } = setUp();
  model.method = "splat";
  const [first, second, ...fine] = complete("splat");
  await receive(first!);
  assert.equal(drawSorted(false), null, "a chunk in view is missing");
  await receive(second!);
  assert.equal(drawSorted(true), null, "the picture of this view is better than coarse chunks");
  assert.ok(!model.replacesPictures);
  assert.deepEqual([model.loading?.arrival.nChunks, model.loading?.arrival.nIncomplete], [2, 2]);
  await receive(...fine);
  assert.equal(draw(), null, "splats cannot be drawn before they are sorted");
  answerWorkers();
  assert.equal(draw(), "splat");
  assert.ok(model.replacesPictures && model.isShown && model.loading === null);
});

test("while the view moves, coarse chunks replace the picture", async () => {
  const { model, drawSorted, receive } = setUp();
  model.method = "splat";
  await receive(chunk("splat", 1, 2, 1), chunk("splat", 2, 2));
  assert.equal(drawSorted(false), "splat");
});

test("another model replaces the drawn one when its chunks or its picture are there", async () => {
  const { model, drawSorted, receive } = setUp();
  model.method = "splat";
  await receive(...complete("splat"));
  assert.equal(drawSorted(), "splat");
  model.method = "tsdf";
  assert.equal(drawSorted(), "splat");
  assert.ok(!model.replacesPictures, "pictures of the other model are needed");
  await receive(chunk("tsdf", 1, 2, 1), chunk("splat", 1, 0));
  assert.equal(drawSorted(), "splat");
  await receive(chunk("tsdf", 2, 2));
  assert.equal(drawSorted(), "tsdf");
  model.method = "splat";
  model.pictureArrived();
  assert.equal(drawSorted(), null);
  await receive(...complete("splat"));
  assert.equal(drawSorted(), "splat");
});

test("chunks survive a new connection until all of them were sent again", async () => {
  const { model, drawSorted, receive } = setUp();
  model.method = "splat";
  await receive(...complete("splat"));
  assert.equal(drawSorted(), "splat");
  const old = model.drawn;
  model.renew();
  assert.ok(model.replacesPictures);
  const messages = complete("splat");
  for (const message of messages.slice(0, -1)) {
    await receive(message);
    drawSorted(false);
    assert.equal(model.drawn, old);
  }
  model.pictureArrived();
  model.renew(); // The connection was lost again.
  await receive(...messages);
  drawSorted(false);
  assert.notEqual(model.drawn, old);
  assert.ok(model.replacesPictures);
});

test("a copy with holes in the view gives way to the picture, and returns without holes", async () => {
  const { model, drawSorted, receive } = setUp();
  model.method = "splat";
  await receive({ ...chunk("splat", 1, 2, 1), n_unsent_in_view: 0 });
  assert.equal(drawSorted(false), "splat");
  model.pictureArrived();
  assert.equal(drawSorted(false), "splat", "the view is covered");
  model.receive({ ...chunk("splat", 1, 1, 1) }, new Uint8Array(16)); // The view has turned.
  await receive();
  assert.ok(!model.replacesPictures);
  assert.equal(drawSorted(false), "splat", "until there is a picture");
  model.pictureArrived();
  assert.equal(drawSorted(false), null);
  await receive(chunk("splat", 2, 0));
  assert.equal(drawSorted(), "splat");
});

test("without local drawing, the copy stays until a picture has arrived", async () => {
  const { model, drawSorted, receive } = setUp();
  model.method = "splat";
  await receive(...complete("splat"));
  drawSorted();
  model.method = null;
  assert.equal(drawSorted(), "splat");
  assert.ok(!model.replacesPictures);
  await receive(chunk("splat", 1, 0));
  model.pictureArrived();
  assert.equal(drawSorted(), null);
});
