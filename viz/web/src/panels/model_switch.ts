// The switch between models trained in parallel; hidden if there is only one.

import { element } from "./element";
import { make } from "./html";
import type { ModelStatus, Status } from "../connection/protocol";

export class ModelSwitch {
  private readonly group = element("models");
  private chosen: string | undefined;
  private listed = "";

  constructor(private readonly changed: () => void) {}

  /** The method to request pictures from; undefined selects the server's first. */
  get method(): string | undefined {
    return this.chosen;
  }

  /** The model that the user has chosen; null if it is the server's first. */
  get preferred(): string | null {
    return this.chosen ?? null;
  }

  /** Chooses a model before the list of models is known. A model that is not in the list is then dropped. */
  prefer(method: string | null): void {
    if (method !== this.preferred) this.choose(method ?? undefined);
  }

  /** The selected model. */
  shown(status: Status): ModelStatus {
    return status.others.find((model) => model.method === this.chosen) ?? status;
  }

  /** Updates the list of models. */
  list(status: Status): void {
    const methods = [status, ...status.others].map((model) => model.method);
    if (methods.join() === this.listed) return;
    this.listed = methods.join();
    if (this.chosen !== undefined && !methods.includes(this.chosen)) this.choose(undefined);
    this.group.hidden = methods.length < 2;
    this.group.replaceChildren(...methods.map((method) => this.button(method)));
    this.mark();
  }

  private button(method: string): HTMLButtonElement {
    const button = make("button", { textContent: method, title: `Show the model of the method ${method}` });
    Object.assign(button.dataset, { method, server: "" });
    button.addEventListener("click", () => this.choose(method));
    return button;
  }

  private choose(method: string | undefined): void {
    this.chosen = method;
    this.mark();
    this.changed();
  }

  private mark(): void {
    const shown = this.chosen ?? this.listed.split(",")[0];
    for (const button of this.group.querySelectorAll("button")) {
      button.setAttribute("aria-pressed", String(button.dataset.method === shown));
    }
  }
}
