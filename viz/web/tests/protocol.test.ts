import assert from "node:assert/strict";
import { test } from "node:test";
import { agree } from "../src/connection/negotiation";
import { CAPABILITIES, type Hello, unframe } from "../src/connection/protocol";

function framed(header: string, payload: number[], nHeader?: number): ArrayBuffer {
  const text = new TextEncoder().encode(header);
  const message = new Uint8Array(4 + text.length + payload.length);
  new DataView(message.buffer).setUint32(0, nHeader ?? text.length, true);
  message.set(text, 4);
  message.set(payload, 4 + text.length);
  return message.buffer;
}

const HELLO: Hello = {
  type: "hello",
  protocol: 4,
  protocols: [3, 5],
  capabilities: ["views", "from_the_future", "parts"],
  server: "fieldrig",
  client: 1,
  role: "operator",
  max_size_px: [4096, 4096],
  default_stages: [0.25, 1],
  clock_millis: 0,
};

test("a binary message consists of header length, header and payload", () => {
  const { header, payload } = unframe(framed('{"type":"live_image","camera":"Kürbis"}', [1, 2, 3]));
  assert.deepEqual(header, { type: "live_image", camera: "Kürbis" });
  assert.deepEqual([...payload], [1, 2, 3]);
  assert.equal(unframe(framed('{"type":"picture"}', [])).payload.length, 0);
});

test("truncated messages and invalid headers are rejected", () => {
  assert.throws(() => unframe(new ArrayBuffer(3)));
  assert.throws(() => unframe(framed('{"type":"picture"}', [], 4_000_000_000)));
  assert.throws(() => unframe(framed('{"type":"picture"}', [], 5)));
});

test("both sides use the capabilities that both have", () => {
  const topics = ["tides", "weather"];
  const agreement = agree({ ...HELLO, capabilities: [...HELLO.capabilities!, "weather"] }, topics);
  assert.ok(typeof agreement !== "string");
  assert.deepEqual([...agreement.capabilities], ["views", "parts", "weather"]);
  const capabilities = [...CAPABILITIES, ...topics];
  assert.deepEqual(agreement.hello, { type: "hello", protocols: [3, 4], capabilities });
});

test("an old server gets no reply that it does not understand", () => {
  const { protocols: _, capabilities: __, ...old } = HELLO;
  const agreement = agree({ ...old, protocol: 3 }, []);
  assert.ok(typeof agreement !== "string");
  assert.deepEqual([agreement.capabilities.size, agreement.hello], [0, null]);
});

test("servers without a common version are refused with both ranges", () => {
  const tooNew = agree({ ...HELLO, protocol: 6, protocols: [5, 6] }, []);
  assert.equal(tooNew, "the server uses protocol version 5 to 6, this page 3 to 4: reload the page");
  const { protocols: _, ...old } = HELLO;
  const tooOld = agree({ ...old, protocol: 2 }, []);
  assert.equal(tooOld, "the server uses protocol version 2, this page 3 to 4: reload the page");
});
