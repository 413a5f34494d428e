import assert from "node:assert/strict";
import { test } from "node:test";
import { Connection } from "../src/connection/connection";

class FakeSocket {
  static readonly OPEN = 1;
  static made: FakeSocket[] = [];
  readyState = FakeSocket.OPEN;
  onopen = (): void => undefined;
  onclose = (): void => undefined;
  onmessage = (_event: { data: unknown }): void => undefined;

  constructor() {
    FakeSocket.made.push(this);
  }

  send(): void {}

  close(): void {
    this.readyState = 3;
  }
}

const HELLO = { type: "hello", protocol: 3, protocols: [3, 4], capabilities: ["subscribe"], clock_millis: 0 };

test("a server that answers late is not open before its hello", ({ mock }) => {
  let millis = 0;
  mock.method(performance, "now", () => millis);
  let check = (): void => undefined;
  const fakeWindow = { setInterval: (callback: () => void) => (check = callback), setTimeout: (callback: () => void) => callback() };
  Object.assign(globalThis, { WebSocket: FakeSocket, location: { host: "robot" }, window: fakeWindow });
  const states: string[] = [];
  const events = { state: (state: string) => states.push(state), text: () => undefined, binary: () => undefined };
  const connection = new Connection("ws://robot/ws", events, () => []);
  const wait = (duration: number): void => {
    for (let ms = 0; ms < duration; ms += 100) {
      millis += 100;
      check();
    }
  };
  FakeSocket.made[0]!.onopen();
  wait(1500);
  // Clients subscribe on `open`, so it must follow the hello, which lists the topics.
  assert.deepEqual(states, []);
  FakeSocket.made[0]!.onmessage({ data: JSON.stringify(HELLO) });
  assert.deepEqual(states, ["open"]);
  assert.ok(connection.isOpen && connection.supports("subscribe"));
  wait(1000);
  assert.equal(states.at(-1), "silent");
  assert.ok(connection.isOpen);
  FakeSocket.made[0]!.onmessage({ data: JSON.stringify({ type: "heartbeat", clock_millis: 1 }) });
  assert.equal(states.at(-1), "open");
});
