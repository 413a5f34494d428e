// Pauses and continues training.

import type { Connection } from "./connection";
import { element } from "./element";
import type { Status } from "./protocol";

export class PauseButton {
  private readonly button = element("pause", HTMLButtonElement);
  private isPaused = false;

  constructor(private readonly connection: Connection) {
    this.button.addEventListener("click", () => connection.send({ type: "pause", is_paused: !this.isPaused }));
  }

  show(status: Status): void {
    this.isPaused = status.state === "paused";
    this.button.hidden = !this.connection.supports("pause") || !(this.isPaused || status.state === "training");
    this.button.setAttribute("aria-pressed", String(this.isPaused));
  }
}
