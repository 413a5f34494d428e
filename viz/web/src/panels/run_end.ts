// The end of a run: a panel with the verdict, the folder and the files. It can be closed, and opened again from the header.

import { disableServerControls } from "../connection/access";
import type { RunResult, Status } from "../connection/protocol";
import { closesWithEscape } from "../keys";
import { element } from "./element";
import { closePanel } from "./focus";
import { fileLinks } from "./file_links";
import { child, descriptions, make } from "./html";
import { timeText } from "./quantities";
import { SMALL_WINDOW } from "./windows";

const ENDED = "The program has ended, so this is no longer possible";

export class RunEnd {
  private readonly panel = element("run-end");
  private readonly opener = element("show-result", HTMLButtonElement);
  private status: Status | null = null;
  private hasEnded = false;
  /** What the panel shows, so that it is only rebuilt if something has changed. */
  private shown = "";

  constructor() {
    this.opener.addEventListener("click", () => this.setOpen(this.panel.hidden !== false));
    closesWithEscape("card", () => !this.panel.hidden, () => this.close(), this.panel);
  }

  show(status: Status): void {
    const hadResult = this.status !== null && this.status.result !== null;
    const hasResult = status.result !== null;
    this.status = status;
    this.opener.hidden = !hasResult;
    if (hasResult !== hadResult) this.setOpen(hasResult);
    this.update();
  }

  /** Sets whether the program has ended. The page keeps what it has received, and disables what needs the program. */
  setEnded(hasEnded: boolean): void {
    if (hasEnded === this.hasEnded) return;
    this.hasEnded = hasEnded;
    if (hasEnded) disableServerControls(ENDED); // The next hello enables them.
    this.update();
  }

  private setOpen(isOpen: boolean): void {
    this.panel.hidden = !isOpen;
    this.opener.setAttribute("aria-expanded", String(isOpen));
  }

  private close(): void {
    closePanel(this.panel, this.opener, () => this.setOpen(false));
  }

  private update(): void {
    const result = this.status?.result;
    if (!this.status || !result) return;
    const files = this.status.files ?? [];
    const shown = JSON.stringify([result, files, this.hasEnded]);
    if (shown === this.shown) return;
    const isFirst = this.shown === "";
    this.shown = shown;
    const wasOpen = this.panel.querySelector("details")?.open ?? true;
    const details = make("details");
    details.open = isFirst ? !window.matchMedia(SMALL_WINDOW).matches : wasOpen;
    const summary = child("summary", verdictText(result));
    summary.id = "run-verdict";
    const links = child("p");
    links.className = "files";
    const folder = result.folder ?? "the folder of the run";
    links.append(...fileLinks(files, this.hasEnded ? folder : null));
    const problems = child("ul");
    problems.className = "problems";
    problems.append(...(result.problems ?? []).map((problem) => child("li", problem)));
    const state = child("p", stateText(this.hasEnded, files.length > 0));
    state.id = "run-end-state";
    details.append(summary, problems, descriptions(rows(result)), links, state);
    this.panel.dataset.grade = result.verdict?.grade ?? "unknown";
    this.panel.replaceChildren(details, this.closeButton());
  }

  private closeButton(): HTMLButtonElement {
    const title = "Close. The button Result in the header opens this again";
    const button = make("button", { id: "close-result", textContent: "×", title, ariaLabel: "Close the result" });
    button.addEventListener("click", () => this.close());
    return button;
  }
}

/** The verdict. Servers without one send only scores. */
export function verdictText(result: RunResult): string {
  if (result.verdict) return result.verdict.text;
  return result.scores === "" ? "The run has ended" : `The run has ended: ${result.scores}`;
}

function rows(result: RunResult): [string, string][] {
  const folder: [string, string][] = result.folder === null ? [] : [["Saved in", result.folder]];
  const time: [string, string][] = result.seconds > 0 ? [["Training time", timeText(result.seconds)]] : [];
  return [...folder, ...time];
}

/** What is still possible. `hasFiles`: whether the page has offered files. */
export function stateText(hasEnded: boolean, hasFiles: boolean): string {
  if (!hasEnded) return "You can still look at the model, until the program is stopped in its terminal.";
  const kept = "The program has ended. The page keeps the last picture, and the parts of the model that it has received.";
  return hasFiles ? `${kept} Its files are in the folder of the run.` : kept;
}
