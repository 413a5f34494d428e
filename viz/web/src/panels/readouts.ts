// Text readouts of the run's values.

import { Chart } from "./chart";
import { element } from "./element";
import { child, setList, setText } from "./html";
import { storeText } from "./header";
import { bytesText, countText, stepTimeText, timeText } from "./quantities";
import type { ModelStatus, Status } from "../connection/protocol";

export class Readouts {
  private readonly chart = new Chart(element("chart", HTMLCanvasElement));

  show(status: Status, model: ModelStatus): void {
    text("method", status.others.length === 0 ? model.method : ""); // Otherwise the switch shows the method.
    text("psnr", model.psnr === null ? "–" : model.psnr.toFixed(2));
    text("seconds", timeText(status.seconds));
    text("step", countText(model.step));
    text("step-millis", stepTimeText(model.step_millis));
    // Edits hide splats only when the model is drawn or exported.
    const note = model.edits > 0 ? " before edits" : "";
    text("primitives-label", `${model.primitives_label || "Primitives"}${note}`);
    text("primitives", countText(model.primitives));
    text("bytes", bytesText(model.bytes));
    showKeyframes(status);
    showNotes(status);
    const others = [status, ...status.others].filter((other) => other.method !== model.method);
    this.chart.set(model.psnr_history, others.map((other) => other.psnr_history));
  }
}

/**
 * Shows the counts of the images. Saved models have only the number of keyframes, and files of
 * other programs have no counts.
 */
function showKeyframes({ state, keyframes, rejected, images, store }: Status): void {
  const isSaved = state === "viewing";
  element("keyframes-card").hidden = isSaved && keyframes === 0;
  const reasons = Object.entries(rejected).sort((a, b) => b[1] - a[1]);
  const nRejected = reasons.reduce((sum, [, n]) => sum + n, 0);
  row("keyframes", store ? storeText(store) : countText(keyframes));
  row("accepted", images ? countText(images.accepted) : null);
  row("evicted", images && images.evicted > 0 ? countText(images.evicted) : null);
  row("dropped-total", images ? countText(images.dropped) : null);
  row("rejected-total", isSaved ? null : countText(nRejected));
  setList(element("rejected"), reasons, ([reason, n]) => [
    child("dt", reason.replaceAll("_", " ")),
    child("dd", countText(n)),
  ]);
}

/** Shows a value, or hides it with its label if it is null. */
function row(id: string, value: string | null): void {
  element(`${id}-label`).hidden = value === null;
  element(id).hidden = value === null;
  if (value !== null) text(id, value);
}

/** Warnings come first. The button for checkpoints shows the note on its result. */
function showNotes({ notes, infos, checkpoint }: Status): void {
  const isInfo = (note: string): boolean => infos?.includes(note) ?? false;
  const shown = notes.filter((note) => note !== checkpoint?.text);
  const sorted = [...shown.filter((note) => !isInfo(note)), ...shown.filter(isInfo)];
  element("notes-card").hidden = sorted.length === 0;
  const items = sorted.map((note) => [note, isInfo(note) ? "info" : "warning"] as const);
  setList(element("notes"), items, ([note, kind]) => {
    const item = child("li", note);
    item.dataset.kind = kind;
    return [item];
  });
}

function text(id: string, value: string): void {
  setText(element(id), value);
}
