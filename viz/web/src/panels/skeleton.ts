// A background with a text about the state of the run, in place of a view that would be black.
//
// It is shown until the first picture, and while the browser has discarded the drawing. After a
// reconnection, the last picture stays, but gray, until a new one has arrived.

import type { ConnectionState } from "../connection/connection";
import type { Status } from "../connection/protocol";
import { make, setText } from "./html";
import { isNothingShown, type Knowledge, type Shown, skeletonText } from "./skeleton_text";

export class Skeleton {
  private readonly root = make("div", { id: "skeleton", className: "skeleton" });
  private readonly title = make("strong");
  private readonly detail = make("span");
  private readonly bar = make("progress", { ariaLabel: "Progress" });
  private readonly known: Knowledge = { connection: "connecting", status: null, isContextLost: false };
  private readonly shown: Shown = { hasPicture: false, hasContent: false, isStartup: false, isContextLost: false };
  private isAwaiting = false;
  private isModelShown = true;

  /** `view` contains the canvas, which the skeleton covers. */
  constructor(
    private readonly view: HTMLElement,
    canvas: HTMLElement,
  ) {
    const text = make("p", { role: "status" });
    text.append(this.title, this.detail);
    this.root.append(text, this.bar);
    canvas.after(this.root);
    this.show();
  }

  setConnection(connection: ConnectionState): void {
    this.known.connection = connection;
    this.show();
  }

  setStatus(status: Status): void {
    this.known.status = status;
    this.shown.isStartup = status.progress?.is_startup === true;
    this.show();
  }

  /** Whether the operator wants to see the model. Without it, an empty view is expected. */
  set showsModel(isShown: boolean) {
    this.isModelShown = isShown;
    this.show();
  }

  set isContextLost(isLost: boolean) {
    this.known.isContextLost = isLost;
    this.shown.isContextLost = isLost;
    if (!isLost) this.awaitPicture();
    this.show();
  }

  /**
   * To be called after a reconnection, and after the browser has discarded the drawing. The shown
   * picture is then out of date until the next one arrives.
   */
  awaitPicture(): void {
    this.isAwaiting = this.shown.hasPicture;
    this.show();
  }

  /** To be called when the picture was removed, because it belongs to another run. */
  forgetPicture(): void {
    this.shown.hasPicture = false;
    this.shown.hasContent = false;
    this.show();
  }

  /** To be called when a picture is shown; `depth` is 0 where it shows the background. */
  pictureShown(depth: Float32Array | null): void {
    this.isAwaiting = false;
    this.shown.hasPicture = true;
    this.shown.hasContent ||= depth?.some((meters) => meters > 0) ?? true;
    this.show();
  }

  /** Whether the view is covered. */
  get isVisible(): boolean {
    return !this.root.hidden;
  }

  private show(): void {
    this.root.hidden = !isNothingShown(this.shown) || (!this.isModelShown && !this.known.isContextLost);
    this.view.classList.toggle("awaiting", this.isAwaiting);
    if (this.root.hidden) return;
    const { title, detail, doneFrac } = skeletonText(this.known);
    setText(this.title, title);
    setText(this.detail, detail);
    this.bar.hidden = doneFrac === null;
    if (doneFrac !== null) this.bar.value = doneFrac;
  }
}
