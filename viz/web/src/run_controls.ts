// Buttons that control the run.

import type { Connection } from "./connection";
import { element } from "./element";
import type { Status } from "./protocol";

/** States in which a run can be controlled. */
const CONTROLLABLE = ["waiting for images", "collecting keyframes", "training", "paused"];

export class RunControls {
  private isPaused = false;

  constructor(private readonly connection: Connection) {
    element("pause").addEventListener("click", () => {
      connection.send({ type: "control", action: this.isPaused ? "resume" : "pause" });
    });
    element("save").addEventListener("click", () => connection.send({ type: "control", action: "save" }));
  }

  show(status: Status): void {
    this.isPaused = status.state === "paused";
    element("pause").textContent = this.isPaused ? "Continue" : "Pause";
    element("controls").hidden = !this.connection.supports("control") || !CONTROLLABLE.includes(status.state);
  }
}
