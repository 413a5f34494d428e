// The keyframe browser: chooses a keyframe, compares its photograph with the model, and describes
// its faults.

import type { Connection } from "../connection/connection";
import { KeyframePhotos } from "../connection/keyframe_photos";
import type { BinaryHeader, ErrorMessage, LiveImageHeader, NumberedKeyframe } from "../connection/protocol";
import { pickFrustum } from "../layers/frustum_picker";
import { SideView } from "../layers/side_view";
import type { KeyframesTopic } from "../topics/keyframes";
import type { OrbitView } from "../view/orbit_view";
import { closesWithEscape, isPageCovered } from "../keys";
import { element } from "./element";
import { closePanel } from "./focus";
import { type CommonRequest, type Comparison, type DecodedPhoto, KeyframeComparer } from "./keyframe_comparison";
import { correctionText, keyframeFaults, type PoseDifference, poseDifference } from "./keyframe_faults";
import { type KeyframeOrder, keyframeKey, nearestKeyframe, neighborKeyframe, orderedKeyframes } from "./keyframe_order";
import { KeyframePanel } from "./keyframe_panel";
import { KeyframeSurvey } from "./keyframe_survey";
import { durationText } from "./quantities";

/** Maximum size of the photograph that is shown, and of those that are only measured. */
const SHOWN_PX: [number, number] = [640, 640];
const MEASURED_PX: [number, number] = [160, 160];
/** While the model trains, the shown picture is requested again at most this often. */
const REFRESH_MILLIS = 2000;
/** A press and release of the pointer that moves less than this is a click. */
const MAX_CLICK_PX = 4;

/** What the browser needs from the rest of the page. */
export interface BrowserSources {
  connection: Connection;
  view: OrbitView;
  topic: KeyframesTopic;
  /** What pictures of the model have in common. */
  common(): CommonRequest;
  /** The newest live image with a pose. */
  live(): LiveImageHeader | null;
  /** Radius of the scene, meters. */
  radiusM(): number;
}

export class KeyframeBrowser {
  readonly photos: KeyframePhotos;
  private readonly sides: readonly [SideView, SideView];
  private readonly comparer: KeyframeComparer;
  private readonly survey: KeyframeSurvey;
  private readonly panel: KeyframePanel;
  private readonly opener = element("look-nearest", HTMLButtonElement);
  private order: KeyframeOrder = "time";
  private shown: NumberedKeyframe | null = null;
  /** The comparison on display. */
  private compared: Comparison | null = null;
  private isComparing = false;
  private comparedAt = 0;
  private isOutdated = false;

  constructor(private readonly sources: BrowserSources) {
    const { connection, topic } = sources;
    this.photos = new KeyframePhotos(connection);
    this.sides = [new SideView(connection, "keyframe"), new SideView(connection, "keyframe_survey")];
    const comparer = (side: SideView, maxPx: [number, number], isUrgent: boolean): KeyframeComparer =>
      new KeyframeComparer(this.photos, side, sources.common, maxPx, isUrgent);
    this.comparer = comparer(this.sides[0], SHOWN_PX, true);
    const surveyed = comparer(this.sides[1], MEASURED_PX, false);
    this.survey = new KeyframeSurvey(surveyed, () => topic.list.keyframes, () => this.showTitle());
    this.panel = new KeyframePanel(element("view").querySelector<HTMLElement>(".tools")!, {
      step: (step) => this.step(step),
      nearest: () => this.open(),
      lookFrom: () => this.shown && sources.view.lookFromKeyframe(this.shown),
      order: (order) => this.sort(order),
      close: () => this.close(),
    });
    closesWithEscape("panel", () => this.panel.isOpen, () => this.close(), this.panel.root);
    topic.onChange.push(() => this.listChanged());
    window.addEventListener("keydown", (event) => this.pressed(event));
    this.pickFrustums(element("canvas"));
    window.setInterval(() => this.refresh(), REFRESH_MILLIS / 4);
  }

  /** Opens the browser at the keyframe nearest to the view, or closes it. */
  toggle(): void {
    if (this.panel.isOpen) this.close();
    else this.open();
  }

  /** Takes a message if it is for the keyframe browser. Returns whether it was. */
  receive(header: BinaryHeader, payload: Uint8Array<ArrayBuffer>): boolean {
    if (header.type === "picture") return this.sides.some((side) => side.receive(header, payload));
    return this.photos.receive(header, payload);
  }

  /** Takes an error if it is about a request of the keyframe browser. Returns whether it was. */
  fail(error: ErrorMessage): boolean {
    return this.sides.some((side) => side.fail(error)) || this.photos.fail(error);
  }

  /** To be called when a connection was opened, because the server may be another one. */
  restart(): void {
    this.photos.restart();
    for (const side of this.sides) side.restart();
    this.comparer.restart();
    this.modelChanged(true);
  }

  /**
   * To be called when the model has changed. If `isOther` is set, it is another model, and no
   * measurement is valid any more.
   */
  modelChanged(isOther: boolean): void {
    this.isOutdated = true;
    if (isOther) this.survey.forget();
  }

  private open(): void {
    const { view, topic, radiusM } = this.sources;
    this.setOpen(true);
    const nearest = nearestKeyframe(topic.list.keyframes, view.view().world_from_camera, radiusM());
    if (nearest) this.show(nearest);
    else this.panel.clear("There are no keyframes yet", [4, 3]);
    this.showTitle();
  }

  private close(): void {
    closePanel(this.panel.root, this.opener, () => this.setOpen(false));
    this.shown = null;
    this.sources.view.overlays.select(null);
    this.sources.view.changed();
  }

  private setOpen(isOpen: boolean): void {
    this.panel.isOpen = isOpen;
    this.panel.canSort = this.photos.isPossible;
    this.opener.setAttribute("aria-expanded", String(isOpen));
    this.survey.enabled = isOpen && this.order === "error";
  }

  private sort(order: KeyframeOrder): void {
    this.order = order;
    // The model may have changed since the last time.
    if (order === "error") this.survey.forget();
    this.survey.enabled = order === "error";
    this.showTitle();
  }

  private step(step: number): void {
    if (!this.shown) return;
    const next = neighborKeyframe(this.ordered(), this.shown, step);
    if (next) this.show(next);
  }

  private ordered(): NumberedKeyframe[] {
    return orderedKeyframes(this.sources.topic.list.keyframes, this.order, this.survey.psnrOf);
  }

  /** Shows a keyframe, at first without images. */
  private show(keyframe: NumberedKeyframe): void {
    const isOther = !this.isShown(keyframe);
    // A correction has moved the keyframe, so it needs another picture of the model.
    if (this.shown?.world_from_camera.join() !== keyframe.world_from_camera.join()) this.isOutdated = true;
    this.shown = keyframe;
    this.sources.view.overlays.select(keyframe);
    this.sources.view.changed();
    this.showTitle();
    if (!isOther) return;
    this.compared = null;
    this.panel.clear("Waiting for the photograph and the model's picture", keyframe.size_px);
    this.panel.showFacts(this.facts(keyframe, null), []);
    this.panel.root.dataset.state = "waiting";
    void this.compare();
  }

  /** Compares the shown keyframe. If another keyframe is chosen meanwhile, it is compared next. */
  private async compare(): Promise<void> {
    if (this.isComparing) {
      // The request for the previous keyframe is not worth waiting for.
      this.sides[0].abandon("another keyframe was chosen");
      return;
    }
    this.isComparing = true;
    for (let keyframe = this.shown; keyframe; keyframe = this.isShown(keyframe) ? null : this.shown) {
      const compared = keyframe;
      this.isOutdated = false;
      const comparison = await this.comparer.compare(compared, (photo) => {
        if (this.isShown(compared)) this.panel.showPhoto(photo);
      });
      if (this.isShown(compared)) this.display(comparison);
    }
    this.isComparing = false;
    this.comparedAt = performance.now();
  }

  private isShown(keyframe: NumberedKeyframe): boolean {
    return this.shown !== null && keyframeKey(this.shown) === keyframeKey(keyframe);
  }

  private display(comparison: Comparison): void {
    const { photo, render, errors } = comparison;
    this.compared = comparison;
    this.panel.showPhoto(photo);
    this.panel.showRender(render);
    const problems = [
      ...(typeof photo === "string" ? [`No photograph: ${photo}`] : []),
      ...(typeof render === "string" ? [`No picture of the model: ${render}`] : []),
    ];
    this.panel.showProblem(problems.join(". "));
    if (typeof photo !== "string") this.panel.showErrors(errors, [photo.image.width, photo.image.height]);
    else this.panel.showErrors(null, [0, 0]);
    this.showTexts();
  }

  /** Shows the facts and the faults, which depend on the time. */
  private showTexts(): void {
    const { compared } = this;
    if (!compared || !this.shown) return;
    const header = typeof compared.photo === "string" ? null : compared.photo.header;
    const faults = keyframeFaults(compared.errors, {
      correction: this.correction(this.shown, header),
      ageSecs: this.age(this.shown).secs,
      turnRadS: header?.turn_rad_s ?? null,
    });
    const isGood = faults.length === 0 && compared.errors !== null;
    this.panel.showFacts(this.facts(this.shown, compared), isGood ? ["nothing is wrong with this keyframe"] : faults);
    this.panel.root.dataset.faults = String(faults.length);
  }

  private facts(keyframe: NumberedKeyframe, compared: Comparison | null): [string, string][] {
    const header = compared && typeof compared.photo !== "string" ? compared.photo.header : null;
    const errors = compared?.errors;
    const correction = this.correction(keyframe, header);
    const facts: [string, string | undefined][] = [
      ["Camera", keyframe.camera],
      ["Taken", this.age(keyframe).text],
      ["Stamp", `${(keyframe.stamp_nanos * 1e-9).toFixed(3)} s`],
      ["Size", `${keyframe.size_px.join(" × ")} px`],
      ["Used for", header ? useText(header.split) : undefined],
      ["PSNR", errors ? `${errors.psnr.toFixed(1)} dB` : undefined],
      ["Exposure", errors?.exposureEv != null ? `${signed(errors.exposureEv, 1)} EV` : undefined],
      ["Sharpness", errors?.detailRatio != null ? `${(100 * errors.detailRatio).toFixed(0)} % of the model's` : undefined],
      ["Correction", correction ? correctionText(correction) : undefined],
      ["Motion", header ? motionText(header) : undefined],
      ["Depth", header ? (header.has_depth ? "yes" : "no") : undefined],
    ];
    return facts.filter((fact): fact is [string, string] => fact[1] !== undefined);
  }

  private correction(keyframe: NumberedKeyframe, header: DecodedPhoto["header"] | null): PoseDifference | null {
    return header && poseDifference(header.reported_world_from_camera, keyframe.world_from_camera);
  }

  /**
   * The age of a keyframe. It is relative to the live image, whose stamp is on the same clock.
   * Without a live image, it is relative to the newest keyframe.
   */
  private age({ stamp_nanos: stampNanos }: NumberedKeyframe): { secs: number; text: string } {
    const live = this.sources.live();
    const liveMillis = live ? this.sources.connection.clock.ageOf(live.captured_millis)() : null;
    const secsBefore = (nanos: number): number => (nanos - stampNanos) * 1e-9;
    if (live && liveMillis !== null && secsBefore(live.stamp_nanos) >= 0) {
      const secs = secsBefore(live.stamp_nanos) + liveMillis / 1000;
      return { secs, text: `${durationText(secs)} ago` };
    }
    const newest = this.sources.topic.list.keyframes.reduce((max, { stamp_nanos }) => Math.max(max, stamp_nanos), stampNanos);
    const secs = secsBefore(newest);
    return { secs, text: secs > 0 ? `${durationText(secs)} before the newest keyframe` : "newest keyframe" };
  }

  private showTitle(): void {
    if (!this.panel.isOpen) return;
    const ordered = this.ordered();
    const ix = this.shown ? ordered.findIndex((keyframe) => this.isShown(keyframe)) : -1;
    const place = ix < 0 ? "Keyframe that was removed" : `Keyframe ${ix + 1} of ${ordered.length}`;
    const { nMeasured } = this.survey;
    const isMeasuring = this.order === "error" && nMeasured < ordered.length;
    this.panel.showTitle(this.shown ? place : "Keyframes", isMeasuring ? `${nMeasured} of ${ordered.length} measured so far` : "");
  }

  private listChanged(): void {
    if (!this.panel.isOpen) return;
    const { keyframes } = this.sources.topic.list;
    const current = keyframes.find((keyframe) => this.isShown(keyframe));
    if (current) this.show(current);
    else if (!this.shown) this.open();
    else this.showTitle();
  }

  /** Requests the picture again after changes, and shows the age. */
  private refresh(): void {
    if (!this.panel.isOpen || document.hidden) return;
    this.panel.canSort = this.photos.isPossible;
    // There may be new keyframes, or another model.
    this.survey.enabled = this.order === "error";
    this.showTexts();
    const isDue = this.isOutdated && performance.now() - this.comparedAt > REFRESH_MILLIS;
    if (isDue && !this.isComparing && this.sources.connection.isOpen) void this.compare();
  }

  /** Arrow keys choose the neighbors, unless something else uses them. */
  private pressed(event: KeyboardEvent): void {
    const step = event.key === "ArrowRight" ? 1 : event.key === "ArrowLeft" ? -1 : 0;
    const { target } = event;
    const isOurs = target === document.body || (target instanceof Node && this.panel.root.contains(target));
    const isField = target instanceof HTMLInputElement || target instanceof HTMLSelectElement;
    if (step === 0 || !this.panel.isOpen || !isOurs || isField || isPageCovered()) return;
    event.preventDefault();
    this.step(step);
  }

  /** Opens the keyframe whose frustum is clicked. */
  private pickFrustums(canvas: HTMLElement): void {
    let pressedAt: [number, number] = [0, 0];
    canvas.addEventListener("pointerdown", (event) => (pressedAt = [event.clientX, event.clientY]));
    canvas.addEventListener("click", (event) => {
      const moved = Math.hypot(event.clientX - pressedAt[0], event.clientY - pressedAt[1]);
      const { view } = this.sources;
      if (moved > MAX_CLICK_PX || view.isToolInUse) return;
      const { keyframes, depthM } = view.overlays.drawnKeyframes;
      const numbered = keyframes.filter((keyframe): keyframe is NumberedKeyframe => "id" in keyframe);
      const windowPx: [number, number] = [canvas.clientWidth, canvas.clientHeight];
      const picked = pickFrustum(numbered, depthM, view.view(), windowPx, [event.offsetX, event.offsetY]);
      if (!picked) return;
      this.setOpen(true);
      this.show(picked);
    });
  }
}

function useText(split: DecodedPhoto["header"]["split"]): string {
  return { train: "training", validation: "validation, not trained on", test: "test, not trained on" }[split];
}

function motionText({ speed_m_s: speed, turn_rad_s: turn }: DecodedPhoto["header"]): string | undefined {
  if (speed === null || turn === null) return undefined;
  return `${speed.toFixed(2)} m/s, ${((turn * 180) / Math.PI).toFixed(0)} degrees/s`;
}

function signed(value: number, digits: number): string {
  const text = Math.abs(value).toFixed(digits);
  return Number(text) === 0 ? text : `${value < 0 ? "−" : "+"}${text}`;
}
