// The elements of the comparison of camera images with the model: photograph and model behind a wiper, map of the error, facts and faults.

import { make, setText } from "./html";
import type { DecodedPhoto } from "./keyframe_comparison";
import type { KeyframeErrors } from "./keyframe_error";
import type { KeyframeOrder } from "./keyframe_order";

/** What the operator does in the panel. */
export interface PanelEvents {
  step(step: number): void;
  nearest(): void;
  lookFrom(): void;
  order(order: KeyframeOrder): void;
  close(): void;
}

/** Errors above this have the last color of the scale. */
const MAX_ERROR = 0.2;
/** Colors of inferno (matplotlib), from no error to the largest. */
const COLORS = [
  [0, 0, 4],
  [87, 16, 110],
  [188, 55, 84],
  [249, 142, 9],
  [252, 255, 164],
] as const;
const MASKED_COLOR = [58, 66, 78] as const;

export class KeyframePanel {
  readonly root = make("section", { id: "keyframe-browser", className: "panel keyframe-browser", ariaLabel: "Compare", tabIndex: -1, hidden: true });
  private readonly title = make("h2", { id: "keyframe-title", ariaLive: "polite" });
  /** The list of what can be compared. */
  readonly sourceList = make("select", { id: "compare-source", title: "What is compared with the model" });
  private readonly order = make("select", { id: "keyframe-order", title: "Order of the keyframes" });
  private readonly photo = make("canvas", { id: "keyframe-photo", role: "img", ariaLabel: "Photograph" });
  private readonly render = make("canvas", { id: "keyframe-render", role: "img", ariaLabel: "Model, from the same pose" });
  private readonly views = make("div", { className: "wiped" });
  private readonly wiper = make("input", { id: "keyframe-wiper", type: "range", min: "0", max: "100", value: "50" });
  private readonly problem = make("p", { id: "keyframe-problem" });
  private readonly error = make("canvas", { id: "keyframe-error", role: "img", ariaLabel: "Map of the error" });
  private readonly facts = make("dl", { id: "keyframe-facts" });
  private readonly faults = make("ul", { id: "keyframe-faults" });
  /** The buttons that choose another keyframe. */
  private readonly steps: HTMLButtonElement[] = [];
  private shownFacts = "";
  private readonly progress = make("span", { id: "keyframe-progress" });

  constructor(parent: HTMLElement, private readonly events: PanelEvents) {
    this.root.setAttribute("aria-labelledby", this.title.id);
    this.order.append(new Option("oldest first", "time"), new Option("largest error first", "error"));
    this.order.ariaLabel = this.order.title;
    this.sourceList.ariaLabel = this.sourceList.title;
    this.order.addEventListener("change", () => events.order(this.order.value as KeyframeOrder));
    this.wiper.ariaLabel = "Boundary between the photograph on the left and the model on the right";
    this.wiper.addEventListener("input", () => this.wipe());
    this.faults.ariaLabel = "What is wrong with this keyframe";
    this.root.append(this.head(), this.figures(), this.facts, this.faults, this.buttons());
    parent.append(this.root);
    this.wipe();
  }

  /** Shows or hides the panel. While it is open, it has the focus. */
  set isOpen(isOpen: boolean) {
    if (this.root.hidden === !isOpen) return;
    this.root.hidden = !isOpen;
    if (isOpen) this.root.focus({ preventScroll: true });
  }

  get isOpen(): boolean {
    return !this.root.hidden;
  }

  /** Whether the user chooses keyframes. */
  set canStep(canStep: boolean) {
    for (const control of [...this.steps, this.order, this.progress]) control.hidden = !canStep;
  }

  /** Whether keyframes can be sorted by their error. */
  set canSort(canSort: boolean) {
    this.order.disabled = !canSort;
  }

  showTitle(title: string, progress: string): void {
    setText(this.title, title);
    this.progress.textContent = progress;
  }

  /** Clears the images, because another keyframe of this size is shown. */
  clear(note: string, [width, height]: [number, number]): void {
    for (const canvas of [this.photo, this.render, this.error]) canvas.width = 0;
    // The panel keeps its layout while the images are loaded.
    this.showSize([width, height]);
    this.views.dataset.missing = "";
    this.problem.textContent = note;
    this.showFacts([], []);
    this.root.dataset.state = "waiting";
  }

  /** Gives the images the shape of this size. */
  showSize([width, height]: [number, number]): void {
    for (const { style } of [this.views, this.error]) style.aspectRatio = `${width} / ${height}`;
  }

  showPhoto(photo: DecodedPhoto | string): void {
    if (typeof photo === "string") this.photo.width = 0;
    else paint(this.photo, photo.image);
    this.showWhole();
  }

  showRender(render: ImageData | string): void {
    if (typeof render === "string") this.render.width = 0;
    else paint(this.render, render);
    this.showWhole();
  }

  /** If one of the two images is missing, the other one is shown as a whole. */
  private showWhole(): void {
    const isMissing = this.photo.width === 0 || this.render.width === 0;
    if (isMissing) this.views.dataset.missing = "";
    else delete this.views.dataset.missing;
  }

  /** Shows why an image is missing. The text is empty if no image is missing. */
  showProblem(problem: string): void {
    this.problem.textContent = problem;
  }

  showErrors(errors: KeyframeErrors | null, [width, height]: [number, number]): void {
    if (errors) paint(this.error, errorImage(errors.map, width, height));
    else this.error.width = 0;
  }

  showFacts(facts: [string, string][], faults: string[]): void {
    this.root.dataset.state = "shown";
    // Ages are updated all the time. Unchanged elements are kept, so that their text can be
    // selected and copied.
    const key = JSON.stringify([facts, faults]);
    if (key === this.shownFacts) return;
    this.shownFacts = key;
    const rows = facts.map(([name, value]) => {
      const row = make("div");
      row.append(make("dt", { textContent: name }), make("dd", { textContent: value }));
      return row;
    });
    this.facts.replaceChildren(...rows);
    this.faults.replaceChildren(...faults.map((fault) => make("li", { textContent: fault })));
  }

  private head(): HTMLElement {
    const head = make("div", { className: "head" });
    this.steps.push(
      this.button("keyframe-previous", "‹", "Previous keyframe (left arrow key)", () => this.events.step(-1)),
      this.button("keyframe-next", "›", "Next keyframe (right arrow key)", () => this.events.step(1)),
      this.button("keyframe-nearest", "Nearest", "The keyframe nearest to the view", () => this.events.nearest()),
    );
    head.append(
      this.title,
      this.sourceList,
      ...this.steps,
      this.order,
      this.progress,
      this.button("keyframe-close", "×", "Close (Esc)", () => this.events.close()),
    );
    return head;
  }

  private figures(): HTMLElement {
    const compared = make("figure");
    const caption = make("figcaption");
    caption.append(make("span", { textContent: "camera image" }), make("span", { textContent: "model" }));
    this.views.append(this.photo, this.render, this.problem);
    // The boundary follows a drag over the images, too.
    this.views.addEventListener("pointerdown", (event) => {
      this.views.setPointerCapture(event.pointerId);
      this.wipeTo(event);
    });
    this.views.addEventListener("pointermove", (event) => {
      if (event.buttons > 0) this.wipeTo(event);
    });
    compared.append(this.views, this.wiper, caption);
    const error = make("figure");
    const scale = make("i");
    scale.style.background = `linear-gradient(to right, ${COLORS.map((color) => `rgb(${color.join(" ")})`).join(", ")})`;
    const labels = make("figcaption", { title: "Difference of the camera image and the model; gray: not trained on" });
    const percents = ["error 0", `${50 * MAX_ERROR} %`, `${100 * MAX_ERROR} % or more`];
    labels.append(...percents.map((textContent) => make("span", { textContent })));
    error.append(this.error, scale, labels);
    const figures = make("div", { className: "figures" });
    figures.append(compared, error);
    return figures;
  }

  private buttons(): HTMLElement {
    const buttons = make("p", { className: "buttons" });
    buttons.append(
      this.button("keyframe-look", "Look from here", "Move the view to the pose of this image", () =>
        this.events.lookFrom(),
      ),
    );
    return buttons;
  }

  private button(id: string, text: string, title: string, act: () => void): HTMLButtonElement {
    const button = make("button", { id, textContent: text, title, type: "button" });
    if (text.length < 2) button.ariaLabel = title;
    button.addEventListener("click", act);
    return button;
  }

  private wipe(): void {
    this.views.style.setProperty("--wiper", `${this.wiper.value}%`);
  }

  private wipeTo(event: PointerEvent): void {
    const { left, width } = this.views.getBoundingClientRect();
    this.wiper.value = String((100 * (event.clientX - left)) / Math.max(1, width));
    this.wipe();
  }
}

/** Draws an image at its own size; the browser scales the canvas. */
function paint(canvas: HTMLCanvasElement, image: ImageData): void {
  canvas.width = image.width;
  canvas.height = image.height;
  canvas.getContext("2d")?.putImageData(image, 0, 0);
}

/** The colors of a map of the error. */
function errorImage(map: Float32Array, width: number, height: number): ImageData {
  const image = new ImageData(width, height);
  for (let ix = 0; ix < map.length; ix++) {
    const error = map[ix]!;
    const at = (Math.min(error, MAX_ERROR) / MAX_ERROR) * (COLORS.length - 1);
    const [low, high] = [COLORS[Math.floor(at)] ?? MASKED_COLOR, COLORS[Math.ceil(at)] ?? MASKED_COLOR];
    for (let channel = 0; channel < 3; channel++) {
      const color = error < 0 ? MASKED_COLOR[channel]! : low[channel]! + (high[channel]! - low[channel]!) * (at % 1);
      image.data[4 * ix + channel] = color;
    }
    image.data[4 * ix + 3] = 255;
  }
  return image;
}
