import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import type { SteerMessage } from "../src/steering/messages";
import { SteerSocket } from "../src/steering/steer_socket";
import { fakeClock } from "./close";
import { ARM } from "./steering_examples";

class FakeSocket {
  static readonly OPEN = 1;
  static made: FakeSocket[] = [];
  readyState = 0;
  bufferedAmount = 0;
  readonly sent: string[] = [];
  onopen = (): void => undefined;
  onclose = (): void => undefined;
  onmessage = (_event: { data: unknown }): void => undefined;

  constructor() {
    FakeSocket.made.push(this);
  }

  send(text: string): void {
    this.sent.push(text);
  }

  close(): void {
    this.readyState = 3;
  }

  open(): void {
    this.readyState = FakeSocket.OPEN;
    this.onopen();
  }
}

let log: string[] = [];
let clock: { millis: number };
let socket: SteerSocket;

beforeEach((context) => {
  clock = fakeClock(context as Parameters<typeof fakeClock>[0]);
  FakeSocket.made = [];
  log = [];
  Object.assign(globalThis, { WebSocket: FakeSocket });
  socket = new SteerSocket("ws://robot/steer", {
    opened: () => log.push("opened"),
    closed: () => log.push("closed"),
    message: ({ type }: SteerMessage) => log.push(type),
  });
});

function last(): FakeSocket {
  return FakeSocket.made.at(-1)!;
}

test("it connects only while the server has an arm", () => {
  socket.check();
  assert.equal(FakeSocket.made.length, 0);
  socket.wanted = true;
  last().open();
  last().onmessage({ data: JSON.stringify(ARM) });
  last().onmessage({ data: "damaged" });
  last().onmessage({ data: new ArrayBuffer(4) });
  socket.wanted = false;
  clock.millis += 60_000;
  socket.check();
  assert.deepEqual(log, ["opened", "arm", "closed"]);
  assert.equal(FakeSocket.made.length, 1);
});

test("a closed or silent connection is opened again, with longer pauses until an arm answers", () => {
  socket.wanted = true;
  last().onclose();
  socket.check();
  assert.equal(FakeSocket.made.length, 1, "after a pause");
  clock.millis += 300;
  socket.check();
  assert.equal(FakeSocket.made.length, 2);
  clock.millis += 4100;
  socket.check();
  assert.deepEqual(log, ["closed", "closed"], "nobody answered");
  clock.millis += 300;
  socket.check();
  assert.equal(FakeSocket.made.length, 2, "the second pause is longer");
  clock.millis += 300;
  socket.check();
  assert.equal(FakeSocket.made.length, 3);
});

test("messages of a connection that was given up do not count", () => {
  socket.wanted = true;
  const old = last();
  old.onclose();
  clock.millis += 300;
  socket.check();
  old.open();
  old.onmessage({ data: JSON.stringify(ARM) });
  old.onclose();
  assert.deepEqual(log, ["closed"]);
});

test("over a link that does not keep up, samples are left out, but no release and no stop", () => {
  socket.wanted = true;
  const command = { type: "command", device: 1, sequence: 1, captured_micros: 0, grip: 1 } as const;
  socket.send(command);
  assert.equal(last().sent.length, 0, "not open yet");
  last().open();
  last().bufferedAmount = 1e6;
  socket.send(command);
  socket.send({ ...command, grip: null });
  socket.send({ type: "stop" });
  assert.deepEqual(last().sent.map((text) => JSON.parse(text).type), ["command", "stop"]);
});
