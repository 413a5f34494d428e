// While photographs of a target are taken, draws what they cover over the live image of the camera, and lists what is
// missing.

import type { PhotographCoverage } from "../connection/protocol";
import { cellRectangle, coverageEntries, type Rectangle } from "./coverage_list";
import { element } from "./element";
import { child } from "./html";

const SVG = "http://www.w3.org/2000/svg";
/** Columns and rows of the parts of the image. */
const PARTS: [number, number] = [3, 3];

export class CoverageOverlay {
  private readonly overlay = document.createElementNS(SVG, "svg");
  private readonly list = element("photograph-coverage");
  private readonly resizes = new ResizeObserver(() => this.place());
  private image: HTMLCanvasElement | null = null;
  private shown = "";

  constructor() {
    this.overlay.classList.add("coverage-overlay");
    this.overlay.setAttribute("aria-hidden", "true"); // The list has the same content.
  }

  /** Shows the coverage, or nothing. To be called again when the image of the camera has appeared. */
  show(coverage: PhotographCoverage | undefined): void {
    this.list.hidden = coverage === undefined;
    if (!coverage) {
      this.attach(null);
      this.shown = "";
      return;
    }
    this.attach(document.querySelector(`#live figure[data-camera="${CSS.escape(coverage.camera)}"] canvas`));
    const shown = JSON.stringify(coverage);
    if (shown === this.shown) return;
    this.shown = shown;
    this.draw(coverage);
    this.list.replaceChildren(
      ...coverageEntries(coverage).map(({ text, state }) => {
        const entry = child("li", text);
        entry.dataset.state = state;
        return entry;
      }),
    );
  }

  private draw({ size_px, cells, is_covered, parts }: PhotographCoverage): void {
    this.overlay.setAttribute("viewBox", `0 0 ${size_px[0]} ${size_px[1]}`);
    const covered = is_covered.flatMap((isCovered, ix) => (isCovered ? [rectangle(cellRectangle(ix, cells, size_px), "cell")] : []));
    const missing = parts.flatMap(({ is_covered, is_next }, ix) => {
      if (is_covered) return [];
      return [rectangle(cellRectangle(ix, PARTS, size_px), is_next ? "part next" : "part")];
    });
    // The part that is asked for comes last, so that its border covers those of its neighbors.
    missing.sort((a, b) => a.classList.length - b.classList.length);
    this.overlay.replaceChildren(...covered, ...missing);
  }

  /** Moves the overlay to an image; null removes it. */
  private attach(image: HTMLCanvasElement | null): void {
    if (image === this.image) return;
    this.image = image;
    this.resizes.disconnect();
    if (!image) {
      this.overlay.remove();
      return;
    }
    image.after(this.overlay);
    this.resizes.observe(image);
    this.place();
  }

  /** The image is centered in its canvas element, and the overlay is centered in the same rectangle. */
  private place(): void {
    if (!this.image) return;
    const { offsetLeft, offsetTop, offsetWidth, offsetHeight } = this.image;
    Object.assign(this.overlay.style, {
      left: `${offsetLeft}px`,
      top: `${offsetTop}px`,
      width: `${offsetWidth}px`,
      height: `${offsetHeight}px`,
    });
  }
}

function rectangle(place: Rectangle, className: string): SVGRectElement {
  const rect = document.createElementNS(SVG, "rect");
  for (const [name, value] of Object.entries(place)) rect.setAttribute(name, String(value));
  rect.setAttribute("class", className);
  return rect;
}
