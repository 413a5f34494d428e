// Compares camera images with the model from the same pose: keyframes that the user chooses, the newest keyframe, or live images.
// Describes the faults of each.

import type { Connection } from "../connection/connection";
import { KeyframePhotos } from "../connection/keyframe_photos";
import type { BinaryHeader, ErrorMessage, KeyframeImageHeader, LiveImageHeader, NumberedKeyframe } from "../connection/protocol";
import { pickFrustum } from "../layers/frustum_picker";
import { SideView } from "../layers/side_view";
import type { KeyframesTopic } from "../topics/keyframes";
import type { LiveImagesTopic } from "../topics/live_images";
import type { OrbitView } from "../view/orbit_view";
import { closesWithEscape, isPageCovered } from "../keys";
import { element } from "./element";
import { closePanel } from "./focus";
import { type CommonRequest, type Comparison, type DecodedPhoto, KeyframeComparer, PoseRenderer, type PosedImage } from "./keyframe_comparison";
import { ComparedSource, type Source } from "./compared_source";
import { correctionText, keyframeFaults, type PoseDifference, poseDifference } from "./keyframe_faults";
import { type KeyframeOrder, keyframeKey, nearestKeyframe, neighborKeyframe, orderedKeyframes } from "./keyframe_order";
import { byTime } from "./keyframe_times";
import { KeyframePanel } from "./keyframe_panel";
import { KeyframeSurvey } from "./keyframe_survey";
import { durationText } from "./quantities";

/** Maximum size of the photograph that is shown, and of those that are only measured. */
const SHOWN_PX: [number, number] = [640, 640];
const MEASURED_PX: [number, number] = [160, 160];
/** While the model trains, the shown picture is requested again at most this often. */
const REFRESH_MILLIS = 2000;
/** Live images are compared in at most half of the time, because the server also draws other pictures. */
const MAX_LIVE_FRAC = 0.5;
/** A press and release of the pointer that moves less than this is a click. */
const MAX_CLICK_PX = 4;

/** What the browser needs from the rest of the page. */
export interface BrowserSources {
  connection: Connection;
  view: OrbitView;
  topic: KeyframesTopic;
  /** What pictures of the model have in common. */
  common(): CommonRequest;
  liveImages: LiveImagesTopic;
  /** Radius of the scene, meters. */
  radiusM(): number;
}

export class KeyframeBrowser {
  readonly photos: KeyframePhotos;
  private readonly sides: readonly [SideView, SideView];
  private readonly renderer: PoseRenderer;
  private readonly comparer: KeyframeComparer;
  private readonly source: ComparedSource;
  private readonly survey: KeyframeSurvey;
  private readonly panel: KeyframePanel;
  private readonly opener = element("look-nearest", HTMLButtonElement);
  private order: KeyframeOrder = "time";
  private shown: NumberedKeyframe | null = null;
  /** The live image on display, and the newest one, which waits to be compared. */
  private shownLive: LiveImageHeader | null = null;
  private waitingLive: PosedImage | null = null;
  /** Time before which no live image is compared. */
  private nextLiveAt = 0;
  /** The comparison on display. */
  private compared: Comparison | null = null;
  private isComparing = false;
  private comparedAt = 0;
  private isOutdated = false;

  constructor(private readonly sources: BrowserSources) {
    const { connection, topic } = sources;
    this.photos = new KeyframePhotos(connection);
    this.sides = [new SideView(connection, "keyframe"), new SideView(connection, "keyframe_survey")];
    const [renderer, surveying] = this.sides.map((side) => new PoseRenderer(side, sources.common)) as [PoseRenderer, PoseRenderer];
    this.renderer = renderer;
    this.comparer = new KeyframeComparer(this.photos, renderer, SHOWN_PX, true);
    const surveyed = new KeyframeComparer(this.photos, surveying, MEASURED_PX, false);
    this.survey = new KeyframeSurvey(surveyed, () => topic.list.keyframes, () => this.showTitle());
    this.panel = new KeyframePanel(element("view").querySelector<HTMLElement>(".tools")!, {
      step: (step) => this.step(step),
      nearest: () => this.openNearest(),
      lookFrom: () => this.lookFrom(),
      order: (order) => this.sort(order),
      close: () => this.close(),
    });
    this.source = new ComparedSource(this.panel.sourceList, (source) => this.sourceChanged(source));
    sources.liveImages.onCompared = (image) => {
      this.waitingLive = image;
      void this.compareLive();
    };
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

  /** Opens the browser with the source that was chosen last. */
  private open(): void {
    this.setOpen(true);
    if (this.source.chosen.kind === "stored") this.openNearest();
    else this.sourceChanged(this.source.chosen);
  }

  private openNearest(): void {
    const { view, topic, radiusM } = this.sources;
    this.source.choose({ kind: "stored" });
    const nearest = nearestKeyframe(topic.list.keyframes, view.view().world_from_camera, radiusM());
    if (nearest) this.show(nearest);
    else this.panel.clear("There are no keyframes yet", [4, 3]);
    this.showTitle();
  }

  private close(): void {
    closePanel(this.panel.root, this.opener, () => this.setOpen(false));
    this.sources.liveImages.compared = null;
    this.forgetShown();
  }

  private forgetShown(): void {
    this.shown = null;
    this.shownLive = null;
    this.waitingLive = null;
    this.compared = null;
    this.sources.view.overlays.select(null);
    this.sources.view.changed();
  }

  /** Shows what the user has chosen to compare. */
  private sourceChanged(source: Source): void {
    this.forgetShown();
    this.panel.canStep = source.kind === "stored";
    this.sources.liveImages.compared = source.kind === "live" ? source.camera : null;
    if (source.kind === "stored") this.openNearest();
    else if (source.kind === "newest") this.showNewest();
    else this.panel.clear(`Waiting for an image of ${source.camera}`, [4, 3]);
    this.showTitle();
  }

  private showNewest(): void {
    const newest = byTime(this.sources.topic.list.keyframes).at(-1);
    if (newest) this.show(newest);
    else this.panel.clear("There are no keyframes yet", [4, 3]);
  }

  private lookFrom(): void {
    const live = this.shownLive?.world_from_camera ? { ...this.shownLive, world_from_camera: this.shownLive.world_from_camera } : null;
    const posed = this.shown ?? live;
    if (posed) this.sources.view.lookFromKeyframe(posed);
  }

  /** Compares the newest live image. Images that arrive meanwhile replace each other. */
  private async compareLive(): Promise<void> {
    if (this.isComparing || !this.sources.connection.isOpen || performance.now() < this.nextLiveAt) return;
    const image = this.waitingLive;
    if (!image) return;
    this.waitingLive = null;
    this.isComparing = true;
    const began = performance.now();
    const comparison = await this.renderer.compareLive(image);
    this.isComparing = false;
    const now = performance.now();
    this.nextLiveAt = now + (now - began) * (1 / MAX_LIVE_FRAC - 1);
    const { chosen } = this.source;
    if (this.panel.isOpen && chosen.kind === "live" && chosen.camera === image.header.camera) {
      this.shownLive = image.header;
      this.panel.showSize(image.header.size_px);
      this.display(comparison);
    } else if (this.panel.isOpen && this.shown) {
      void this.compare(); // A keyframe was chosen meanwhile.
    }
  }

  private setOpen(isOpen: boolean): void {
    this.panel.isOpen = isOpen;
    this.panel.canStep = this.source.chosen.kind === "stored";
    this.panel.canSort = this.photos.isPossible;
    this.showSources();
    this.opener.setAttribute("aria-expanded", String(isOpen));
    this.survey.enabled = isOpen && this.order === "error";
  }

  private showSources(): void {
    this.source.list(this.sources.liveImages.current.map(({ camera }) => camera));
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
      // The request for the previous image is not worth waiting for.
      this.renderer.abandon("another image was chosen");
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
    if (!compared) return;
    if (this.shownLive) this.showLiveTexts(this.shownLive, compared);
    if (!this.shown) return;
    const header = typeof compared.photo === "string" ? null : compared.photo.header;
    const faults = keyframeFaults(compared.errors, {
      correction: this.correction(this.shown, header),
      ageSecs: this.age(this.shown).secs,
      turnRadS: header?.turn_rad_s ?? null,
    });
    const isGood = faults.length === 0 && compared.errors !== null;
    this.showFaults(this.facts(this.shown, compared), isGood ? ["nothing is wrong with this keyframe"] : faults, faults.length);
  }

  private showLiveTexts(live: LiveImageHeader, compared: Comparison): void {
    const faults = keyframeFaults(compared.errors, { correction: null, ageSecs: null, turnRadS: null });
    const ageMillis = this.sources.connection.clock.ageOf(live.captured_millis)();
    const facts: [string, string][] = [
      ["Camera", live.camera],
      ["Taken", ageMillis === null ? "live" : `${(ageMillis / 1000).toFixed(1)} s ago`],
      ["Stamp", stampText(live)],
      ["Size", `${live.size_px.join(" × ")} px`],
      ...(compared.newestMillis === null ? [] : [["Newest keyframe", modelAgeText(live, compared.newestMillis)] satisfies [string, string]]),
      ...errorFacts(compared.errors),
    ];
    const isGood = faults.length === 0 && compared.errors !== null;
    this.showFaults(facts, isGood ? ["the image and the model agree"] : faults, faults.length);
  }

  private showFaults(facts: [string, string][], texts: string[], nFaults: number): void {
    this.panel.showFacts(facts, texts);
    this.panel.root.dataset.faults = String(nFaults);
  }

  private facts(keyframe: NumberedKeyframe, compared: Comparison | null): [string, string][] {
    const header = compared && typeof compared.photo !== "string" ? compared.photo.header : null;
    const correction = this.correction(keyframe, header);
    const facts: [string, string | undefined][] = [
      ["Camera", keyframe.camera],
      ["Taken", this.age(keyframe).text],
      ["Stamp", stampText(keyframe)],
      ["Size", `${keyframe.size_px.join(" × ")} px`],
      ["Used for", header ? useText(header.split) : undefined],
      ...errorFacts(compared?.errors),
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
    const live = this.sources.liveImages.latest;
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
    const { chosen } = this.source;
    if (chosen.kind !== "stored") {
      this.panel.showTitle(chosen.kind === "live" ? `Live image of ${chosen.camera}` : "Newest keyframe", "");
      return;
    }
    const ordered = this.ordered();
    const ix = this.shown ? ordered.findIndex((keyframe) => this.isShown(keyframe)) : -1;
    const place = ix < 0 ? "Keyframe that was removed" : `Keyframe ${ix + 1} of ${ordered.length}`;
    const { nMeasured } = this.survey;
    const isMeasuring = this.order === "error" && nMeasured < ordered.length;
    this.panel.showTitle(this.shown ? place : "Keyframes", isMeasuring ? `${nMeasured} of ${ordered.length} measured so far` : "");
  }

  private listChanged(): void {
    if (!this.panel.isOpen) return;
    const { chosen } = this.source;
    if (chosen.kind === "live") return;
    if (chosen.kind === "newest") {
      this.showNewest();
      return;
    }
    const { keyframes } = this.sources.topic.list;
    const current = keyframes.find((keyframe) => this.isShown(keyframe));
    if (current) this.show(current);
    else if (!this.shown) this.openNearest();
    else this.showTitle();
  }

  /** Requests the picture again after changes, and shows the age. */
  private refresh(): void {
    if (!this.panel.isOpen || document.hidden) return;
    this.panel.canSort = this.photos.isPossible;
    this.showSources();
    void this.compareLive(); // If the last image arrived before it could be compared.
    // There may be new keyframes, or another model.
    this.survey.enabled = this.order === "error";
    this.showTexts();
    const isDue = this.shown !== null && this.isOutdated && performance.now() - this.comparedAt > REFRESH_MILLIS;
    if (isDue && !this.isComparing && this.sources.connection.isOpen) void this.compare();
  }

  /** Arrow keys choose the neighbors, unless something else uses them. */
  private pressed(event: KeyboardEvent): void {
    const step = event.key === "ArrowRight" ? 1 : event.key === "ArrowLeft" ? -1 : 0;
    const { target } = event;
    const isOurs = target === document.body || (target instanceof Node && this.panel.root.contains(target));
    const isField = target instanceof HTMLInputElement || target instanceof HTMLSelectElement;
    if (step === 0 || !this.panel.isOpen || this.source.chosen.kind !== "stored" || !isOurs || isField || isPageCovered()) return;
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
      this.source.choose({ kind: "stored" });
      this.sources.liveImages.compared = null;
      this.shownLive = null;
      this.setOpen(true);
      this.show(picked);
    });
  }
}

function errorFacts(errors: Comparison["errors"] | undefined): [string, string][] {
  if (!errors) return [];
  const { psnr, exposureEv, detailRatio } = errors;
  return [
    ["PSNR", `${psnr.toFixed(1)} dB`],
    ...(exposureEv === null ? [] : [["Exposure", `${signed(exposureEv, 1)} EV`] satisfies [string, string]]),
    ...(detailRatio === null ? [] : [["Sharpness", `${(100 * detailRatio).toFixed(0)} % of the model's`] satisfies [string, string]]),
  ];
}

/** How much older the newest keyframe of the model is than a live image. */
function modelAgeText(live: LiveImageHeader, newestMillis: number): string {
  const secs = (live.captured_millis - newestMillis) / 1000;
  return secs < 0.05 ? "as new as the image" : `${secs.toFixed(1)} s before the image`;
}

function stampText({ stamp_nanos: nanos }: { stamp_nanos: number }): string {
  return `${(nanos * 1e-9).toFixed(3)} s`;
}

function useText(split: KeyframeImageHeader["split"]): string {
  return { train: "training", validation: "validation, not trained on", test: "test, not trained on" }[split];
}

function motionText({ speed_m_s: speed, turn_rad_s: turn }: KeyframeImageHeader): string | undefined {
  if (speed === null || turn === null) return undefined;
  return `${speed.toFixed(2)} m/s, ${((turn * 180) / Math.PI).toFixed(0)} degrees/s`;
}

function signed(value: number, digits: number): string {
  const text = Math.abs(value).toFixed(digits);
  return Number(text) === 0 ? text : `${value < 0 ? "−" : "+"}${text}`;
}
