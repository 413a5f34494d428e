// Jogging with keys. While it is on, the keys of JOG_KEYS have no other meaning, and each held key is a dead-man switch.

import { isKeptByFocus, isPageCovered, isPressed, type toggle } from "../keys";
import { element } from "../panels/element";
import type { Commander } from "./commander";
import { deflectionOfKeys, JOG_KEYS } from "./jog";
import type { Part } from "./messages";

const BUTTON = "steer-keys";
/** The keys that choose the part of the robot which the other keys move. */
const PART_KEYS: Readonly<Record<string, Part>> = { Digit1: "arm", Digit2: "base" };

export class JogKeys {
  private readonly held = new Set<string>();

  constructor(
    private readonly commander: Commander,
    addToggle: typeof toggle,
    private readonly choosePart: (part: Part) => void,
  ) {
    const switched = (isOn: boolean): void => {
      this.release();
      // Both use the same keys.
      if (isOn && isPressed("toggle-fly")) element("toggle-fly").click();
    };
    addToggle(BUTTON, switched, () => commander.hasControl);
    window.addEventListener("keydown", (event) => this.press(event), { capture: true });
    window.addEventListener("keyup", ({ code }) => this.up(code), { capture: true });
    this.listenToLosses();
  }

  /** Switches the keys off when control ends or when the view flies. */
  show(): void {
    const isOn = isPressed(BUTTON);
    if (isOn && (!this.commander.hasControl || isPressed("toggle-fly"))) element(BUTTON).click();
  }

  /** Everything after which the page may not see the release of a key. */
  private listenToLosses(): void {
    for (const kind of ["blur", "pagehide"] as const) window.addEventListener(kind, () => this.release());
    document.addEventListener("visibilitychange", () => this.release());
    // Menus, and the lists of selects, take the keyboard.
    window.addEventListener("contextmenu", (event) => event.defaultPrevented || this.release());
    for (const kind of ["focusin", "pointerdown"] as const) {
      window.addEventListener(kind, ({ target }) => target instanceof HTMLSelectElement && this.release(), { capture: true });
    }
  }

  private press(event: KeyboardEvent): void {
    const { code, repeat } = event;
    // While Meta is down, macOS does not report the release of other keys.
    if (event.metaKey) this.release();
    const part = this.commander.hasBothParts ? PART_KEYS[code] : undefined;
    if (!isPressed(BUTTON) || !(code in JOG_KEYS || part) || isKeptByFocus(event) || isPageCovered()) return;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (part) {
      this.release();
      this.choosePart(part);
      return;
    }
    // A key that was held before the page got the focus repeats. It does not count before it is pressed anew.
    if (repeat) return;
    this.held.add(code);
    this.apply();
  }

  private up(code: string): void {
    if (this.held.delete(code)) this.apply();
  }

  private release(): void {
    if (this.held.size === 0) return;
    this.held.clear();
    this.apply();
  }

  private apply(): void {
    const jog = { kind: "tip", deflection: deflectionOfKeys(this.held) } as const;
    this.commander.setJog("keys", this.held.size > 0 ? jog : null);
  }
}
