// What `view` shows: a saved model or a file, with its facts, its files and its direction of up.

import type { Vector3 } from "three";
import type { Axis, ModelSource, ModelStatus, Status } from "../connection/protocol";
import { AXES, upCommand, upInWorld } from "../view/up_axis";
import { element } from "./element";
import { fileLinks } from "./file_links";
import { child, descriptions, make } from "./html";
import { bytesText, countText, timeText } from "./quantities";

export class ModelSourceCard {
  private readonly card = element("source-card");
  /** Where the controls are in a run. */
  private readonly training = element("controls").parentElement;
  private status: Status | null = null;
  private hasEnded = false;
  private chosenUp: Axis | null = null;
  private shown = "";

  /** `turnUp` makes a direction of the world point up. */
  constructor(private readonly turnUp: (up: Vector3) => void) {}

  /** Sets whether the program has ended, so that files can no longer be downloaded. */
  setEnded(hasEnded: boolean): void {
    if (hasEnded === this.hasEnded) return;
    this.hasEnded = hasEnded;
    this.update();
  }

  show(status: Status): void {
    this.status = status;
    this.update();
  }

  private update(): void {
    const source = this.status?.source;
    this.card.hidden = source === undefined;
    if (!this.status) return;
    if (!source) {
      this.restoreRun();
      return;
    }
    const files = this.status.files ?? [];
    const facts = factsOf(source, this.status);
    const shown = JSON.stringify([source, files, facts, this.hasEnded]);
    if (shown === this.shown) return;
    this.shown = shown;
    const links = child("p");
    links.className = "files";
    links.append(...fileLinks(files, this.hasEnded ? source.path : null));
    const title = child("h2", source.kind === "file" ? "File" : "Saved model");
    const name = child("p", source.name);
    name.className = "source-name";
    this.card.replaceChildren(title, name);
    if (source.verdict) {
      const verdict = child("p", source.verdict.text);
      verdict.className = "verdict";
      verdict.dataset.grade = source.verdict.grade;
      this.card.append(verdict);
    }
    this.card.append(descriptions(facts), links);
    if (source.kind === "file") this.card.append(this.upChooser(source));
    // The edits of this model are saved here, because there is no training.
    this.card.append(element("controls"));
  }

  /** Undoes the changes for a source, because the page has reconnected to a run. */
  private restoreRun(): void {
    if (this.shown === "") return;
    this.shown = "";
    this.training?.append(element("controls"));
    if (this.chosenUp) this.turnUp(upInWorld("z", "z"));
    this.chosenUp = null;
  }

  private upChooser(source: ModelSource): HTMLElement {
    const row = child("p");
    row.className = "up-axis";
    const label = child("label", "Up axis ");
    label.htmlFor = "up-axis";
    const choice = make("select", { id: "up-axis" });
    choice.append(...AXES.map((axis) => new Option(axis, axis)));
    choice.value = this.chosenUp ?? source.up_axis;
    const hint = child("small");
    hint.id = "up-hint";
    const showHint = (axis: Axis): void => {
      hint.textContent = axis === source.up_axis ? "" : `This applies only to this window. To keep it: ${upCommand(source.path, axis)}`;
    };
    showHint(choice.value as Axis);
    choice.addEventListener("change", () => {
      this.chosenUp = choice.value as Axis;
      this.turnUp(upInWorld(source.up_axis, this.chosenUp));
      showHint(this.chosenUp);
    });
    row.append(label, choice, hint);
    return row;
  }
}

/** Names and values of the facts about a source and its models. */
export function factsOf(source: ModelSource, status: Status): [string, string][] {
  const models: ModelStatus[] = [status, ...status.others];
  const steps = models.filter((model) => model.step > 0);
  const facts: [string, string | null][] = [
    [source.kind === "file" ? "File" : "Folder", source.path],
    ["Format", source.format],
    ["Method", models.map((model) => model.method).join(", ")],
    ...models.map((model): [string, string] => [model.primitives_label, countText(model.primitives)]),
    ["Size", bytesText(source.bytes)],
    ["Saved", source.modified_unix_secs === null ? null : dateText(source.modified_unix_secs)],
    ["Trained for", status.seconds > 0 ? timeText(status.seconds) : null],
    ["Steps", steps.length > 0 ? steps.map((model) => countText(model.step)).join(", ") : null],
    ["Data", source.data],
    ["Trained on", source.adapter],
  ];
  return facts.filter((fact): fact is [string, string] => fact[1] !== null);
}

/** Date and time in the time zone of the browser. */
function dateText(unixSecs: number): string {
  return new Date(1000 * unixSecs).toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
}
