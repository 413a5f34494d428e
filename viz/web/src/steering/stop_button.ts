// The stop button, for everybody and by a key that works wherever the focus is, and the permission to move again.

import { type action, isTyping } from "../keys";
import { announce } from "../panels/announcer";
import { element } from "../panels/element";
import { setText } from "../panels/html";
import { capitalized } from "../panels/sentence";
import { disable, setTitle } from "../panels/title";
import type { Commander } from "./commander";
import { robotName, stopText } from "./texts";
import { TwoPresses } from "./two_presses";

const REARM = "Permit motion";
const REARM_AGAIN = "Sure? Press again";

export class StopButton {
  private readonly button = element("steer-stop", HTMLButtonElement);
  private readonly rearm = element("steer-rearm", HTMLButtonElement);
  private readonly presses = new TwoPresses(() => performance.now());
  /** Number of the newest stop that the operator sees. */
  private shownStop: number | null = null;
  /** Whether the key is down that has stopped the arm: its release must not press a focused button. */
  private isKeyDown = false;

  constructor(
    private readonly commander: Commander,
    addAction: typeof action,
    private readonly sendRearm: (stop: number) => void,
  ) {
    // A press is faster than a click, which needs the release.
    this.button.addEventListener("pointerdown", () => this.stop());
    addAction("steer-stop", () => this.stop());
    // Before all other listeners, also those of focused buttons and sliders and of dialogs.
    window.addEventListener("keydown", (event) => this.press(event), { capture: true });
    window.addEventListener("keyup", (event) => this.release(event), { capture: true });
    this.rearm.addEventListener("click", () => this.pressRearm());
    // Enter that is held clicks again and again, but counts as one press.
    this.rearm.addEventListener("keydown", (event) => event.repeat && event.preventDefault());
  }

  show(): void {
    const { arm, state, hasControl, canSend, canMove } = this.commander;
    this.button.hidden = !canMove;
    // Without a link, the arm brakes by its own watchdog; a button that does nothing must not look as if it did.
    disable(this.button, canSend ? "" : "The link to the arm is cut: the arm brakes when its commands expire");
    const isOwn = state?.holder === arm?.client;
    const who = typeof state?.holder === "number" ? (isOwn ? "you" : `operator ${state.holder}`) : "";
    setText(element("steer-who"), who !== "" && state?.moved_part ? `${who}: ${state.moved_part}` : who);
    this.showStop(state ? stopText(state) : "");
    setText(element("steer-halt"), state?.is_recovering ? "Arm is being recovered" : `${capitalized(this.robot)} stopped`);
    this.shownStop = state?.stop_number ?? null;
    const reason = state?.is_recovering ? "The arm is being recovered: wait" : "";
    disable(this.rearm, hasControl ? reason : "Only the operator who has control can permit motion");
    setText(this.rearm, this.presses.isAwaited(this.shownStop) ? REARM_AGAIN : REARM);
  }

  private get robot(): string {
    const { arm } = this.commander;
    return robotName(arm === null || arm.joints.length > 0, arm?.base != null);
  }

  private showStop(text: string): void {
    element("steer-stopped").hidden = text === "";
    element("steer-halt").hidden = text === "";
    if (element("steer-stop-text").textContent === text) return;
    setText(element("steer-stop-text"), text);
    setTitle(element("steer-halt"), text);
    if (text !== "") announce(text);
  }

  private stop(): void {
    this.commander.stop();
  }

  private press(event: KeyboardEvent): void {
    if (!this.isStopKey(event)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    this.isKeyDown = true;
    if (!event.repeat) this.stop();
  }

  private release(event: KeyboardEvent): void {
    if (!isSpace(event) || !this.isKeyDown) return;
    this.isKeyDown = false;
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  /** Space, while the arm can move. In fields, it is a letter. */
  private isStopKey(event: KeyboardEvent): boolean {
    return isSpace(event) && this.commander.canMove && !isTyping(event);
  }

  private pressRearm(): void {
    const stop = this.shownStop;
    // The server refuses a permission after a stop that the page has not shown yet, because it has another number.
    if (stop !== null && this.presses.press(stop)) this.sendRearm(stop);
    this.show();
  }
}

/** Whether the key is Space, whatever the input method makes of it. */
function isSpace({ key, code }: KeyboardEvent): boolean {
  return key === " " || code === "Space";
}
