// What the list beside the instruction says about photographs for a lens. Pure, so that it can be tested without a page.

import type { PhotographCoverage } from "../connection/protocol";

export interface CoverageEntry {
  text: string;
  state: "done" | "next" | "missing";
}

/** The entries: the parts of the image as one, and everything else. */
export function coverageEntries({ parts, items }: PhotographCoverage): CoverageEntry[] {
  const nParts = parts.filter((part) => part.is_covered).length;
  const image = {
    text: `parts of the image ${nParts}/${parts.length}`,
    state: stateOf(nParts >= parts.length, parts.some((part) => part.is_next)),
  };
  const others = items.map(({ label, n_done, n_needed, is_next }) => ({
    text: `${label} ${Math.min(n_done, n_needed)}/${n_needed}`,
    state: stateOf(n_done >= n_needed, is_next),
  }));
  return [...others, image];
}

/** A rectangle in pixels of the image. */
export interface Rectangle {
  x: number;
  y: number;
  width: number;
  height: number;
}

/** The rectangle of a cell of a regular grid over an image, by its index row by row. */
export function cellRectangle(ix: number, [columns, rows]: [number, number], sizePx: [number, number]): Rectangle {
  const width = sizePx[0] / columns;
  const height = sizePx[1] / rows;
  return { x: (ix % columns) * width, y: Math.floor(ix / columns) * height, width, height };
}

function stateOf(isDone: boolean, isNext: boolean): CoverageEntry["state"] {
  if (isDone) return "done";
  return isNext ? "next" : "missing";
}
