// A preview shows images, the robot and the devices. It has no model, so everything about models is hidden.

import type { Status } from "../connection/protocol";
import { isPressed } from "../keys";
import type { LiveImagesTopic } from "../topics/live_images";
import { deviceRow, devicesTitle } from "./device_rows";
import { element } from "./element";
import { child, make, setText } from "./html";
import type { ShownModel } from "./shown_model";
import type { Skeleton } from "./skeleton";

/** Buttons that need a model or keyframes. Other such buttons stay hidden until there is one. */
const MODEL_BUTTONS = [
  "look-nearest",
  "toggle-crop",
  "toggle-measure",
  "toggle-model",
  "toggle-keyframes",
  "toggle-age",
  "toggle-uncertainty",
  "toggle-coverage",
  "toggle-cut",
  "toggle-occlude",
];
/** Of these, the topic `observations` shows the buttons when it has data, which a preview has not. */
const SHOWN_BY_TOPICS = ["toggle-age", "toggle-uncertainty", "toggle-coverage"];

export class Preview {
  private readonly card = element("devices-card");
  private isPreview = false;
  private shown = "";

  constructor(
    private readonly model: ShownModel,
    private readonly skeleton: Skeleton,
    private readonly images: LiveImagesTopic,
  ) {}

  /** Whether nothing is trained, so that there are no pictures. */
  get isOn(): boolean {
    return this.isPreview;
  }

  show({ preview }: Status): void {
    this.switch(preview !== undefined);
    if (!preview) return;
    const rows = preview.devices.map(deviceRow);
    const shown = JSON.stringify(rows);
    if (shown === this.shown) return; // Keeps a selection of the text.
    this.shown = shown;
    setText(element("devices-title"), devicesTitle(preview.devices));
    element("devices").replaceChildren(
      ...rows.flatMap(({ name, kind, value, reason }) => {
        const state = child("dd", value);
        state.dataset.kind = kind;
        const row: HTMLElement[] = [child("dt", name), state];
        if (reason !== "") row.push(make("dd", { className: "reason", textContent: reason }));
        return row;
      }),
    );
  }

  private switch(isPreview: boolean): void {
    if (isPreview === this.isPreview) return;
    this.isPreview = isPreview;
    document.body.classList.toggle("preview", isPreview);
    this.card.hidden = !isPreview;
    for (const id of MODEL_BUTTONS) {
      if (isPreview || !SHOWN_BY_TOPICS.includes(id)) element(id).hidden = isPreview;
    }
    const showsModel = !isPreview && isPressed("toggle-model");
    this.model.isVisible = showsModel;
    this.skeleton.showsModel = showsModel;
    this.images.roomy = isPreview;
  }
}
