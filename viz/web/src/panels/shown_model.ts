// The model on the page: follows its changes, and chooses whether the page or the server draws it.

import type { RenderScheduler } from "../connection/render_scheduler";
import type { ModelStatus, Status } from "../connection/protocol";
import type { Surroundings } from "../layers/surroundings";
import type { ModelChunksTopic } from "../topics/model_chunks";
import type { Topics } from "../topics/topic";
import type { OrbitView } from "../view/orbit_view";
import type { EditControls } from "./edit_controls";
import { element } from "./element";
import type { KeyframeBrowser } from "./keyframe_browser";
import type { ModelSwitch } from "./model_switch";
import type { Readouts } from "./readouts";

/** What shows the model or depends on it. */
export interface ModelParts {
  view: OrbitView;
  models: ModelSwitch;
  readouts: Readouts;
  edits: EditControls;
  scheduler: RenderScheduler;
  browser: KeyframeBrowser;
  surroundings: Surroundings;
  topics: Topics;
  chunks: ModelChunksTopic;
}

export class ShownModel {
  /** The newest status; null before the first one. */
  status: Status | null = null;
  private step = -1;
  private isLocal = false;
  private isModelShown = true;

  constructor(private readonly parts: ModelParts) {}

  /** Whether the user wants the page to draw the model. */
  set isDrawnLocally(isDrawnLocally: boolean) {
    this.isLocal = isDrawnLocally;
    this.update();
  }

  get isVisible(): boolean {
    return this.isModelShown;
  }

  /** Whether the user wants to see the model. */
  set isVisible(isVisible: boolean) {
    this.isModelShown = isVisible;
    this.parts.view.showsModel = isVisible;
    this.update();
  }

  receive(status: Status): void {
    this.status = status;
    this.parts.models.list(status);
    this.update();
  }

  /** Number of steps of a model, as far as the status says. */
  stepOf(method: string | undefined): number | undefined {
    return [this.status, ...(this.status?.others ?? [])].find((model) => model?.method === method)?.step;
  }

  /** Forgets where surfaces are, because the model is another one or parts of it are gone. */
  forgetSurfaces(): void {
    this.parts.surroundings.forget();
    this.parts.view.forgetSurfaces();
  }

  /** Adopts the newest status, or another choice of the user. */
  update(): void {
    const { status, parts } = this;
    if (!status) return;
    const model = parts.models.shown(status);
    parts.readouts.show(status, model);
    parts.view.observations.nKeyframes = status.keyframes;
    const isEdited = parts.edits.show(status, model);
    const isChanged = model.step !== this.step;
    this.step = model.step;
    if (isChanged || isEdited) parts.scheduler.modelChanged();
    if (isChanged || isEdited) parts.browser.modelChanged(isEdited);
    if (isEdited) this.forgetSurfaces();
    else if (isChanged) parts.surroundings.modelChanged();
    this.chooseRenderer(model);
  }

  private chooseRenderer(model: ModelStatus): void {
    const { topics, chunks, view } = this.parts;
    const isPossible = topics.isSupported(chunks) && model.has_chunks === true;
    element("toggle-local").hidden = !isPossible;
    chunks.method = isPossible && this.isLocal && this.isModelShown ? model.method : null;
    view.local.erased = model.erased_boxes ?? [];
  }
}
