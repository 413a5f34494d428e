// One line across the view: why the picture is not live, what to do, or how the run ended.

import { timeText } from "./chart";
import type { ConnectionState } from "../connection/connection";
import { element } from "./element";
import type { Guidance, RunResult } from "../connection/protocol";

export class Banner {
  private connection: ConnectionState = "connecting";
  private connectionText = "";
  private result: RunResult | null = null;
  private guidance: Guidance | null = null;
  private graphics = "";

  /** Sets the reason why the scene cannot be drawn; empty if it can. */
  setGraphics(text: string): void {
    this.graphics = text;
    this.show();
  }

  setConnection(state: ConnectionState, text: string): void {
    this.connection = state;
    this.connectionText = text;
    this.show();
  }

  /** Whether the run has ended, so that the server may stop. */
  get isFinished(): boolean {
    return this.result !== null || this.guidance?.is_finished === true;
  }

  setRunResult(result: RunResult | null): void {
    this.result = result;
    this.show();
  }

  setGuidance(guidance: Guidance | null): void {
    this.guidance = guidance;
    this.show();
  }

  private show(): void {
    const isBroken = ["silent", "lost", "refused"].includes(this.connection);
    // Once a run has ended, a stopped server is expected.
    const { result, guidance, isFinished } = this;
    const hasProblem = isBroken && !isFinished;
    const text = result
      ? runResultText(result)
      : capitalized(hasProblem ? this.connectionText : (guidance?.text ?? this.graphics));
    const banner = element("banner");
    if (banner.textContent !== text) banner.textContent = text; // Otherwise screen readers would repeat it.
    const withoutProblem = guidance ? "guidance" : this.graphics ? "graphics" : this.connection;
    banner.dataset.kind = isFinished ? "finished" : hasProblem ? this.connection : withoutProblem;
    element("view").classList.toggle("stale", hasProblem);
  }
}

function runResultText(result: RunResult): string {
  const saved = result.folder === null ? "no model was saved" : `model saved in ${result.folder}`;
  const scores = result.scores === "" ? "" : `, ${result.scores}`;
  return `Finished after ${timeText(result.seconds)}: ${saved}${scores}`;
}

function capitalized(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
