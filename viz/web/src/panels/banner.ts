// One line across the view that shows why the picture is not live, or what to do.

import type { ConnectionState } from "../connection/connection";
import { element } from "./element";
import { setText } from "./html";
import { capitalized } from "./sentence";
import { PHONE } from "./windows";
import type { Guidance, Status } from "../connection/protocol";

const phones = matchMedia(PHONE);

export class Banner {
  private connection: ConnectionState = "connecting";
  private connectionText = "";
  private isResultShown = false;
  private isSavedModel = false;
  private hasEnded = false;
  private guidance: Guidance | null = null;
  private graphics = "";

  constructor() {
    phones.addEventListener("change", () => this.show());
    const header = document.querySelector("header")!;
    new ResizeObserver(() => {
      element("banner").style.setProperty("--header-height", `${header.offsetHeight}px`);
    }).observe(header);
  }

  /** Sets the reason why the scene cannot be drawn; empty if it can. */
  setGraphics(text: string): void {
    this.graphics = text;
    this.show();
  }

  /** `hasEnded`: whether the connection was lost because the program has ended, as expected. */
  setConnection(state: ConnectionState, text: string, hasEnded: boolean): void {
    this.connection = state;
    this.connectionText = text;
    this.hasEnded = hasEnded;
    this.show();
  }

  /** Whether nothing more is expected from the server, so that it may stop. */
  get isFinished(): boolean {
    return this.isResultShown || this.isSavedModel || this.guidance?.is_finished === true;
  }

  /** Adopts whether the run has ended. The result of the run has a separate panel. */
  setStatus(status: Status): void {
    this.isResultShown = status.result !== null;
    this.isSavedModel = status.source !== undefined;
    this.show();
  }

  setGuidance(guidance: Guidance | null): void {
    this.guidance = guidance;
    this.show();
  }

  private show(): void {
    const { guidance, hasEnded } = this;
    const hasProblem = ["silent", "lost", "refused"].includes(this.connection) && !hasEnded;
    // On phones, the panel of the result is one line without this sentence.
    const isUnexplained = hasEnded && guidance === null && (!this.isResultShown || phones.matches);
    const text = hasProblem
      ? capitalized(this.connectionText)
      : isUnexplained
        ? "The program has ended. The page shows what it received last."
        : (guidance?.text ?? this.graphics);
    const banner = element("banner");
    setText(banner, text);
    banner.dataset.kind = hasProblem ? this.connection : text === "" ? "open" : this.kindOfNotice(isUnexplained);
    element("view").classList.toggle("stale", hasProblem);
  }

  private kindOfNotice(isEnd: boolean): string {
    if (isEnd) return "ended";
    if (this.guidance === null) return "graphics";
    return this.guidance.is_finished ? "finished" : "guidance";
  }
}
