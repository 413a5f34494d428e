// One line across the view: why the picture is not live, or how the run ended.

import { timeText } from "./chart";
import type { ConnectionState } from "./connection";
import { element } from "./element";
import type { RunResult } from "./protocol";

export class Banner {
  private connection: ConnectionState = "connecting";
  private connectionText = "";
  private ended: RunResult | null = null;

  setConnection(state: ConnectionState, text: string): void {
    this.connection = state;
    this.connectionText = text;
    this.show();
  }

  /** Whether the run has ended, so that the server may stop. */
  get isFinished(): boolean {
    return this.ended !== null;
  }

  setRunResult(ended: RunResult | null): void {
    this.ended = ended;
    this.show();
  }

  private show(): void {
    const isBroken = this.connection === "silent" || this.connection === "lost";
    // Once a run has ended, a stopped server is expected.
    const { ended, isFinished } = this;
    const text = ended ? runResultText(ended) : isBroken ? capitalized(this.connectionText) : "";
    const banner = element("banner");
    if (banner.textContent !== text) banner.textContent = text; // Otherwise screen readers would repeat it.
    banner.dataset.kind = isFinished ? "finished" : this.connection;
    element("view").classList.toggle("stale", isBroken && !isFinished);
  }
}

function runResultText(ended: RunResult): string {
  const saved = ended.folder === null ? "no model was saved" : `model saved in ${ended.folder}`;
  const scores = ended.scores === "" ? "" : `, ${ended.scores}`;
  return `Finished after ${timeText(ended.seconds)}: ${saved}${scores}`;
}

function capitalized(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
