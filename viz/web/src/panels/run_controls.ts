// Buttons that control the run.

import type { Connection } from "../connection/connection";
import { element } from "./element";
import type { Status } from "../connection/protocol";
import { setTitle, titleOf } from "./title";

/** States in which a run can be controlled. */
export const CONTROLLABLE = ["waiting for images", "collecting keyframes", "training", "paused"];
/** States in which there is a saved model, whose edits can be saved. */
const SAVED = ["viewing", "finished"];

export class RunControls {
  private isPaused = false;

  constructor(private readonly connection: Connection) {
    element("pause").addEventListener("click", () => {
      connection.send({ type: "control", action: this.isPaused ? "resume" : "pause" });
    });
    for (const id of ["save", "save-edits"]) {
      element(id).addEventListener("click", () => connection.send({ type: "control", action: "save" }));
    }
  }

  show(status: Status): void {
    element("checkpoint-note").textContent = status.checkpoint?.text ?? "";
    element("checkpoint-note").dataset.state = status.checkpoint?.state ?? "";
    this.isPaused = status.state === "paused";
    element("pause").textContent = this.isPaused ? "Continue" : "Pause";
    element("pause").dataset.paused = String(this.isPaused);
    const isRunning = CONTROLLABLE.includes(status.state);
    // Undoing all edits must be saved, too.
    const canSaveEdits = SAVED.includes(status.state) && this.connection.supports("edit");
    const canControl = this.connection.supports("control");
    element("controls").hidden = !canControl || !(isRunning || canSaveEdits);
    element("save-edits").hidden = !canControl || !canSaveEdits;
    element("pause").hidden = !isRunning;
    const save = element("save", HTMLButtonElement);
    save.textContent = isRunning ? "Save checkpoint" : "Save edits";
    setTitle(save, isRunning ? "Write a checkpoint now" : titleOf(element("save-edits")));
  }
}
