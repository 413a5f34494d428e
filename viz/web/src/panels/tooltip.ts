// Shows the titles of controls to all users: when the mouse rests on a control, when the keyboard reaches it, and when a
// finger holds it. The title is removed meanwhile; otherwise, the browser would show it a second time.

import { element } from "./element";

const HOVER_MILLIS = 400;
const HOLD_MILLIS = 500;
/** Time in which the mouse can move from the control to the tooltip. */
const LEAVE_MILLIS = 150;
/** A finger that moves farther than this is dragging. */
const MAX_HOLD_PX = 10;
const GAP_PX = 6;
const MARGIN_PX = 8;

export class Tooltip {
  private readonly tooltip = element("tooltip");
  private owner: HTMLElement | null = null;
  private timer = 0;
  private heldAt: [x: number, y: number] | null = null;
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
      document.addEventListener(kind, () => this.endHold(), { capture: true });
    }
    document.addEventListener("click", (event) => this.click(event), { capture: true });
    document.addEventListener("contextmenu", (event) => this.ignoresClick && event.preventDefault(), { capture: true });
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
    const titled = event.pointerType === "touch" ? titledAt(event.target) : null;
    if (!titled) return;
    this.heldAt = [event.clientX, event.clientY];
    this.timer = window.setTimeout(() => {
      this.show(titled);
      this.ignoresClick = true;
    }, HOLD_MILLIS);
  }

  private move(event: PointerEvent): void {
    if (!this.heldAt) return;
    const [x, y] = this.heldAt;
    if (Math.hypot(event.clientX - x, event.clientY - y) > MAX_HOLD_PX) this.endHold();
  }

  private endHold(): void {
    if (!this.heldAt) return;
    this.heldAt = null;
    this.stopTimer();
  }

  private click(event: MouseEvent): void {
    if (!this.ignoresClick) {
      this.hide();
      return;
    }
    this.ignoresClick = false;
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  private show(owner: HTMLElement): void {
    this.hide();
    const text = owner.title;
    if (!text || !owner.isConnected) return;
    this.owner = owner;
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
    if (!owner.title) owner.title = this.tooltip.textContent; // Unless it has a newer one.
  }

  private stopTimer(): void {
    window.clearTimeout(this.timer);
  }
}

/** The element with a title at the target of an event. */
function titledAt(target: EventTarget | null): HTMLElement | null {
  return target instanceof Element ? target.closest<HTMLElement>("[title]:not([title=''])") : null;
}
