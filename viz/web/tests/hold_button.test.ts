import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { holdButton } from "../src/steering/hold_button";
import { JogKeys } from "../src/steering/jog_keys";
import type { Commander, Jog } from "../src/steering/commander";

/** What the modules under test use of an element. */
class FakeElement extends EventTarget {
  readonly classList = { toggle: () => undefined };
  readonly hasPointerCapture = (): boolean => false;
  /** All toggles are on. */
  readonly getAttribute = (): string => "true";
  readonly isContentEditable = false;
  readonly tagName = "BUTTON";
}
class FakeSelect extends FakeElement {}

let page: EventTarget;
let button: FakeElement;
let held: boolean[];

beforeEach(() => {
  page = new EventTarget();
  button = new FakeElement();
  held = [];
  const document = Object.assign(new EventTarget(), { hidden: false, getElementById: () => button, querySelector: () => null });
  const globals = { window: page, document, HTMLElement: FakeElement, HTMLSelectElement: FakeSelect, HTMLInputElement: FakeSelect };
  Object.assign(globalThis, globals);
});

/** Sends an event, first to the element and then to the window. */
function send(kind: string, fields: Record<string, unknown> = {}, target = button): void {
  for (const receiver of [target, page]) {
    const event = new Event(kind, { cancelable: true });
    for (const [name, value] of Object.entries({ target, ...fields })) Object.defineProperty(event, name, { value });
    receiver.dispatchEvent(event);
  }
}

const PRESS = { button: 0, buttons: 1, pointerId: 1 };

function holdFakeButton(): void {
  holdButton(button as unknown as HTMLElement, (isHeld) => held.push(isHeld));
}

test("a button is held from the press to the release", () => {
  holdFakeButton();
  send("pointerdown", { ...PRESS, button: 2 });
  send("pointerdown", PRESS);
  send("pointerdown", { ...PRESS, pointerId: 2 });
  send("pointermove", PRESS);
  assert.deepEqual(held, [true]);
  send("pointerup", { ...PRESS, buttons: 0 });
  assert.deepEqual(held, [true, false]);
});

test("the main button of a mouse is released also while another button stays pressed", () => {
  holdFakeButton();
  send("pointerdown", PRESS);
  send("pointermove", { ...PRESS, buttons: 3 });
  assert.deepEqual(held, [true]);
  send("pointermove", { ...PRESS, buttons: 2 });
  assert.deepEqual(held, [true, false]);
});

test("Enter holds a button, whatever the pointer does elsewhere, and not if it repeats", () => {
  holdFakeButton();
  send("pointerdown", PRESS);
  send("pointerup", PRESS);
  send("keydown", { key: "Enter", repeat: true });
  send("keydown", { key: "Enter", repeat: false });
  page.dispatchEvent(Object.assign(new Event("pointermove"), { pointerId: 1, buttons: 0 }));
  assert.deepEqual(held, [true, false, true]);
  page.dispatchEvent(Object.assign(new Event("keyup"), { key: "Enter" }));
  assert.deepEqual(held, [true, false, true, false], "also if the release goes to another element");
});

for (const [name, lose] of [
  ["the key Meta", () => send("keydown", { key: "Meta", code: "MetaLeft", metaKey: true })],
  ["a menu", () => page.dispatchEvent(new Event("contextmenu"))],
  ["the loss of the focus", () => page.dispatchEvent(new Event("blur"))],
] as const) {
  test(`${name} releases buttons and keys`, () => {
    holdFakeButton();
    send("keydown", { key: "Enter", repeat: false });
    lose();
    assert.deepEqual(held, [true, false]);
    const jogs = jogKeys();
    send("keydown", { key: "w", code: "KeyW" });
    assert.equal(jogs.length, 1);
    lose();
    send("keydown", { key: "w", code: "KeyW", repeat: true });
    assert.deepEqual(jogs.slice(1), [null]);
  });
}

test("the list of a select releases keys, a menu that the page prevents does not", () => {
  const jogs = jogKeys();
  send("keydown", { key: "w", code: "KeyW" });
  const prevented = new Event("contextmenu", { cancelable: true });
  prevented.preventDefault();
  page.dispatchEvent(prevented);
  send("pointerdown", PRESS);
  assert.equal(jogs.length, 1);
  send("pointerdown", PRESS, new FakeSelect());
  assert.deepEqual(jogs.slice(1), [null]);
});

/** What jogging with keys asks for. */
function jogKeys(): (Jog | null)[] {
  const jogs: (Jog | null)[] = [];
  const commander = { hasControl: true, setJog: (_source: string, jog: Jog | null) => jogs.push(jog) };
  new JogKeys(commander as unknown as Commander, () => undefined, () => undefined);
  return jogs;
}
