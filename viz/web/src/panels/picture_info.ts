// Shows the model, the stage and the age of the drawn picture, and removes the colors of an
// outdated picture.

import type { Age, ServerClock } from "../connection/server_clock";
import type { OrbitView } from "../view/orbit_view";
import type { ChunkArrival } from "../layers/chunk_arrival";
import { element } from "./element";
import { setText } from "./html";
import { ageText } from "./quantities";
import { type DrawnHeader, labelText, PictureLabel, type PictureStatus } from "./picture_label";

export class PictureInfo {
  private readonly label = new PictureLabel();
  private answerMillis = 0;
  /** Age of the drawn picture. */
  private age: Age = () => null;
  private readonly info = element("picture-info");
  private readonly text = element("picture-text");
  private readonly localText = element("local-text");
  private readonly marks = [...this.info.querySelectorAll(".stages i")];

  /**
   * `latestStep`: number of steps of a model now, if it is known. `stages`: scales of the stages that the marks stand
   * for.
   */
  constructor(
    private readonly view: OrbitView,
    private readonly clock: () => ServerClock,
    private readonly latestStep: (method: string | undefined) => number | undefined,
    private readonly stages: () => number[],
  ) {
    view.picture.accepts = (header) => this.label.accepts(header);
  }

  /** Whether the view shows the full picture of the wanted view and model. A coarser stage can also be current. */
  get isComplete(): boolean {
    const isFull = this.isLocal || (this.label.header?.scale ?? 0) >= 1 - 1e-9;
    return isFull && this.info.dataset.state === "current";
  }

  /** The drawn model; empty if there is none. */
  get method(): string {
    return this.info.dataset.method ?? "";
  }

  /** The drawn model, and how old its picture is if something has changed since, such as "splat, step 1200, 3 s old". */
  get summary(): string {
    const { step, shownRequest } = this.info.dataset;
    const { header } = this.label;
    const age = header && shownRequest ? this.ageMillis(header, this.status) : null;
    const state = age !== null ? ageText(age) : this.isComplete ? "current" : "incomplete";
    return [this.method, step ? `step ${step}` : "", state].filter((part) => part !== "").join(", ");
  }

  /** Whether pictures can arrive. */
  set isConnected(isConnected: boolean) {
    this.label.setConnected(isConnected, performance.now());
  }

  /** How long a picture has been awaited, milliseconds; null if none is. */
  get waitingMillis(): number | null {
    return this.isLocal ? null : this.status.waitingMillis;
  }

  private get status(): PictureStatus {
    return this.label.status(performance.now());
  }

  private get isLocal(): boolean {
    return this.view.local.root.visible && this.view.local.isShown;
  }

  /** Another view is wanted. */
  viewChanged(): void {
    this.label.viewChanged(performance.now());
    this.update();
  }

  /** Another model is wanted. */
  modelChanged(): void {
    this.label.modelChanged(performance.now());
    this.update();
  }

  /** A picture was requested. */
  requested(id: number): void {
    this.label.requested(id, performance.now());
    this.update();
  }

  /** A picture is drawn. `answerMillis`: time from its request to its arrival. */
  drawn(answerMillis: number): void {
    this.answerMillis = answerMillis;
    this.update();
  }

  /** Shows the present state. To be called for every display refresh, and after every event. */
  update(): void {
    const now = performance.now();
    const drawn = this.view.picture.header;
    if (drawn && drawn !== this.label.header) this.age = this.clock().ageOf(drawn.sent_millis);
    this.label.show(drawn, now);
    const { status } = this;
    if (this.view.picture.setFaded(status.state === "old")) this.view.changed();
    const { loading } = this.view.local;
    setText(this.localText, loading && status.isConnected ? `loading ${loading.method}: ${partsText(loading.arrival)}` : "");
    if (this.isLocal) {
      this.showLocal(status);
      return;
    }
    const { header } = this.label;
    this.set({
      state: status.state,
      method: header?.method ?? "",
      step: numberText(header?.step),
      request: numberText(status.request),
      shownRequest: numberText(header?.id),
    });
    const text = labelText(header, status, this.answerMillis, header && this.ageMillis(header, status));
    setText(this.text, text);
    this.showStages(status.isOfView ? (header?.scale ?? 0) : 0);
  }

  /** The page draws the model itself, and shows how many of its chunks have arrived. */
  private showLocal(status: PictureStatus): void {
    const { drawn, loading } = this.view.local;
    if (drawn) setText(this.text, `drawn here: ${partsText(drawn.arrival)}`);
    const isComplete = drawn !== null && loading === null && drawn.arrival.completesView;
    this.set({
      state: isComplete ? "current" : "waiting",
      method: drawn?.method ?? "",
      step: "",
      request: numberText(status.request),
      shownRequest: "",
    });
    this.showStages(isComplete ? 1 : 0);
  }

  /** Age of the picture, if the model or the view has changed since, or may have. */
  private ageMillis(header: DrawnHeader, status: PictureStatus): number | null {
    const latestStep = this.latestStep(header.method);
    const isOutdated = latestStep !== undefined && header.step !== undefined && latestStep > header.step;
    return isOutdated || !status.isOfView || !status.isConnected ? this.age() : null;
  }

  private set(values: Record<string, string>): void {
    for (const [name, value] of Object.entries(values)) {
      if (this.info.dataset[name] !== value) this.info.dataset[name] = value;
    }
  }

  /** Fills the marks of the stages up to a scale. */
  private showStages(scale: number): void {
    this.marks.forEach((mark, ix) => {
      mark.classList.toggle("done", scale >= (this.stages()[ix] ?? 1) - 1e-9);
    });
  }
}

function partsText({ nChunks, nIncomplete }: ChunkArrival): string {
  return nIncomplete > 0 ? `${nChunks - nIncomplete} of ${nChunks} parts` : `${nChunks} parts`;
}

function numberText(value: number | null | undefined): string {
  return value === null || value === undefined ? "" : String(value);
}
