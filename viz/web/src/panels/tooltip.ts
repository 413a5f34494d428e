// Shows the titles of controls to all users: when the mouse rests on a control, when the keyboard reaches it, and when a
// finger holds it. The title is removed meanwhile; otherwise, the browser would show it a second time.

import { element } from "./element";
import { inTouchWords } from "./gestures";
import { HOLD_MILLIS, isHold } from "./hold";

const HOVER_MILLIS = 400;
/** Time in which the mouse can move from the control to the tooltip. */
const LEAVE_MILLIS = 150;
/** A finger that moves farther than this is dragging. */
const MAX_HOLD_PX = 10;
const GAP_PX = 6;
const MARGIN_PX = 8;

/** A touch of a control that has not ended. */
interface Held {
  control: HTMLElement;
  pointer: number;
  x: number;
  y: number;
  pressedMillis: number;
  isAnswered: boolean;
}

export class Tooltip {
  private readonly tooltip = element("tooltip");
  private owner: HTMLElement | null = null;
  private ownerTitle = "";
  private timer = 0;
  private held: Held | null = null;
  /** Whether the end of the touch must not cause a click, because the touch only requested the tooltip. */
  private ignoresClick = false;

  constructor() {
    document.addEventListener("pointerover", (event) => this.enter(event));
    document.addEventListener("pointerout", (event) => this.leave(event));
    document.addEventListener("focusin", (event) => {
      const titled = titledAt(event.target);
      if (titled?.matches(":focus-visible")) this.show(titled);
    });
    document.addEventListener("focusout", () => this.hide());
    document.addEventListener("pointerdown", (event) => this.press(event), { capture: true });
    document.addEventListener("pointermove", (event) => this.move(event), { capture: true });
    for (const kind of ["pointerup", "pointercancel"] as const) {
      document.addEventListener(kind, (event) => this.release(event), { capture: true });
    }
    document.addEventListener("click", (event) => this.click(event), { capture: true });
    document.addEventListener("contextmenu", (event) => this.openMenu(event), { capture: true });
    document.addEventListener("keydown", (event) => event.key === "Escape" && this.hide(), { capture: true });
    window.addEventListener("resize", () => this.hide());
  }

  private enter(event: PointerEvent): void {
    if (event.pointerType === "touch") return;
    const isInside = this.owner?.contains(event.target as Node) || this.tooltip.contains(event.target as Node);
    const titled = titledAt(event.target);
    if (isInside || titled) this.stopTimer();
    if (!isInside && titled) this.timer = window.setTimeout(() => this.show(titled), HOVER_MILLIS);
  }

  private leave(event: PointerEvent): void {
    if (event.pointerType === "touch") return;
    this.stopTimer();
    if (this.owner) this.timer = window.setTimeout(() => this.hide(), LEAVE_MILLIS);
  }

  private press(event: PointerEvent): void {
    if (!this.tooltip.contains(event.target as Node)) this.hide();
    this.ignoresClick = false;
    const control = event.pointerType === "touch" ? titledAt(event.target) : null;
    if (!control) return;
    const { pointerId: pointer, clientX: x, clientY: y, timeStamp: pressedMillis } = event;
    const held = { control, pointer, x, y, pressedMillis, isAnswered: false };
    this.held = held;
    this.timer = window.setTimeout(() => this.answer(held), HOLD_MILLIS);
  }

  private answer(held: Held): void {
    this.show(held.control, true);
    held.isAnswered = this.owner !== null;
  }

  private move({ pointerId, clientX, clientY }: PointerEvent): void {
    if (this.held?.pointer !== pointerId) return;
    // A tooltip that is shown stays until the next touch.
    if (!this.held.isAnswered && Math.hypot(clientX - this.held.x, clientY - this.held.y) > MAX_HOLD_PX) this.endHold();
  }

  private release({ type, pointerId, timeStamp: releasedMillis }: PointerEvent): void {
    const { held } = this;
    if (held?.pointer !== pointerId) return;
    this.endHold();
    if (type === "pointerup") this.ignoresClick = isHold({ ...held, releasedMillis });
  }

  private endHold(): void {
    this.held = null;
    this.stopTimer();
  }

  /**
   * A touch that shows a tooltip opens no menu of the browser, which would end the touch. The browser may ask first
   * where its own time for a long touch is shorter or the page is busy.
   */
  private openMenu(event: Event): void {
    if (this.held && !this.held.isAnswered) this.answer(this.held);
    if (this.ignoresClick || this.held?.isAnswered) event.preventDefault();
  }

  private click(event: MouseEvent): void {
    // Clicks by keys and by scripts have no count.
    const isIgnored = this.ignoresClick && event.detail > 0;
    this.ignoresClick = false;
    if (!isIgnored) {
      this.hide();
      return;
    }
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  private show(owner: HTMLElement, isTouched = false): void {
    this.hide();
    const text = isTouched ? (owner.dataset.touchTitle ?? inTouchWords(owner.title)) : owner.title;
    if (!text || !owner.isConnected) return;
    this.owner = owner;
    this.ownerTitle = owner.title;
    owner.removeAttribute("title");
    owner.setAttribute("aria-describedby", "tooltip");
    this.tooltip.textContent = text;
    this.tooltip.hidden = false;
    this.place(owner.getBoundingClientRect());
  }

  /** Below the control, or above it where there is no space. */
  private place({ left, width, top, bottom }: DOMRect): void {
    const { offsetWidth, offsetHeight } = this.tooltip;
    const isBelow = bottom + GAP_PX + offsetHeight + MARGIN_PX <= window.innerHeight;
    const x = left + 0.5 * (width - offsetWidth);
    const farthest = Math.max(MARGIN_PX, window.innerWidth - offsetWidth - MARGIN_PX);
    this.tooltip.style.left = `${Math.min(Math.max(x, MARGIN_PX), farthest)}px`;
    this.tooltip.style.top = `${Math.max(MARGIN_PX, isBelow ? bottom + GAP_PX : top - GAP_PX - offsetHeight)}px`;
  }

  private hide(): void {
    this.stopTimer();
    const { owner } = this;
    if (!owner) return;
    this.owner = null;
    this.tooltip.hidden = true;
    owner.removeAttribute("aria-describedby");
    if (!owner.title) owner.title = this.ownerTitle; // Unless it has a newer one.
  }

  private stopTimer(): void {
    window.clearTimeout(this.timer);
  }
}

/** The element with a title at the target of an event. */
function titledAt(target: EventTarget | null): HTMLElement | null {
  return target instanceof Element ? target.closest<HTMLElement>("[title]:not([title=''])") : null;
}
