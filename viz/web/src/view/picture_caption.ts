// Names saved pictures, and draws what they show into their lower edges.

import type { Identity } from "../connection/protocol";
import type { Legend } from "../layers/observation_layer";

/** Height of a line of text, and distance of texts from the edges, CSS pixels. */
const LINE_PX = 18;
const MARGIN_PX = 8;
const MAX_LEGEND_PX = 460;

/** A time on the local clock, such as "2026-11-29 11:09:34". */
export function timeText(time: Date): string {
  const digits = (value: number): string => String(value).padStart(2, "0");
  const date = [time.getFullYear(), digits(time.getMonth() + 1), digits(time.getDate())].join("-");
  return `${date} ${[time.getHours(), time.getMinutes(), time.getSeconds()].map(digits).join(":")}`;
}

/** The name of a file without spaces: the run, the model and the time, where known. */
export function pictureName(identity: Identity | undefined, method: string, time: Date): string {
  const run = identity?.run ?? identity?.rig ?? "";
  const parts = ["fieldrig", run, method, timeText(time).replaceAll(":", "")].filter((part) => part !== "");
  return `${parts.join("-").replace(/[^\p{L}\p{N}._-]+/gu, "-")}.png`;
}

/** Draws a text and the legend of the colors over the lower edge of a picture. `scale`: pixels per CSS pixel. */
export function drawCaption(context: CanvasRenderingContext2D, scale: number, text: string, legend: Legend | null): void {
  const { canvas } = context;
  const [line, margin] = [LINE_PX * scale, MARGIN_PX * scale];
  const height = (legend ? 4 : 1) * line + margin;
  const width = canvas.width - 2 * margin;
  context.translate(margin, canvas.height - height);
  context.fillStyle = "#0b0e13cc";
  context.fillRect(-margin, 0, canvas.width, height);
  context.font = `${12 * scale}px sans-serif`;
  context.textBaseline = "middle";
  context.fillStyle = "#fff";
  const middleOf = (row: number): number => 0.5 * margin + (row + 0.5) * line;
  context.fillText(text, 0, middleOf(legend ? 3 : 0), width);
  if (!legend) return;
  const { title, labels, colors } = legend;
  context.fillText(`${title} (gray: in no keyframe)`, 0, middleOf(0), width);
  const legendWidth = Math.min(width, MAX_LEGEND_PX * scale);
  labels.forEach((label, ix) => {
    const share = ix / (labels.length - 1);
    context.textAlign = share === 0 ? "left" : share === 1 ? "right" : "center";
    context.fillText(label, share * legendWidth, middleOf(2));
  });
  const gradient = context.createLinearGradient(0, 0, legendWidth, 0);
  for (const [ix, color] of colors.entries()) gradient.addColorStop(ix / (colors.length - 1), color);
  context.fillStyle = gradient;
  context.fillRect(0, middleOf(1) - 0.25 * line, legendWidth, 0.5 * line);
}
