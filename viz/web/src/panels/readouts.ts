// Text readouts of the run's values.

import { Chart, timeText } from "./chart";
import { element } from "./element";
import type { ModelStatus, Status } from "../connection/protocol";

export class Readouts {
  private readonly chart = new Chart(element("chart", HTMLCanvasElement));

  show(status: Status, model: ModelStatus): void {
    text("state", status.state);
    text("method", status.others.length === 0 ? model.method : ""); // Otherwise the switch shows the method.
    text("psnr", model.psnr === null ? "–" : model.psnr.toFixed(2));
    text("seconds", timeText(status.seconds));
    text("step", count(model.step));
    text("step-millis", model.step_millis === null ? "–" : `${model.step_millis.toPrecision(3)} ms`);
    text("primitives-label", model.primitives_label || "Primitives");
    text("primitives", count(model.primitives));
    text("bytes", bytesText(model.bytes));
    text("keyframes", count(status.keyframes));
    // A saved model lists only accepted keyframes.
    for (const id of ["rejected-label", "rejected-total"]) element(id).hidden = status.state === "viewing";
    const reasons = Object.entries(status.rejected).sort((a, b) => b[1] - a[1]);
    text("rejected-total", count(reasons.reduce((sum, [, n]) => sum + n, 0)));
    element("rejected").replaceChildren(
      ...reasons.flatMap(([reason, n]) => [child("dt", reason.replaceAll("_", " ")), child("dd", count(n))]),
    );
    element("notes-card").hidden = status.notes.length === 0;
    element("notes").replaceChildren(...status.notes.map((note) => child("li", note)));
    const others = [status, ...status.others].filter((other) => other.method !== model.method);
    this.chart.set(model.psnr_history, others.map((other) => other.psnr_history));
  }
}

function text(id: string, value: string): void {
  element(id).textContent = value;
}

function child(tag: string, value: string): HTMLElement {
  const made = document.createElement(tag);
  made.textContent = value;
  return made;
}

function count(n: number): string {
  return n.toLocaleString("en-US");
}

export function bytesText(bytes: number): string {
  if (bytes < 1024 * 1024) return `${(bytes / 1024).toFixed(0)} KiB`;
  if (bytes < 1024 ** 3) return `${(bytes / 1024 ** 2).toFixed(1)} MiB`;
  return `${(bytes / 1024 ** 3).toFixed(2)} GiB`;
}
