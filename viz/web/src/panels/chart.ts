// Accuracy of all models over time on a canvas; the selected model is highlighted.

import { timeText } from "./quantities";

/** Minimum distance between time labels. */
const MIN_TICK_PX = 50;
const MARGIN = { left: 30, right: 8, top: 8, bottom: 18 };
const MIN_SPAN_DB = 2;

export type Curve = [seconds: number, psnr: number][];

export class Chart {
  private points: Curve = [];
  private others: Curve[] = [];
  private hovered: number | null = null;
  /** Size in CSS pixels. Reading it from the canvas would lay the page out. */
  private sizePx = { width: 0, height: 0 };
  private shown = "";

  constructor(private readonly canvas: HTMLCanvasElement) {
    new ResizeObserver((entries) => {
      const { width, height } = entries[entries.length - 1]!.contentRect;
      this.sizePx = { width, height };
      this.draw();
    }).observe(canvas);
    canvas.addEventListener("pointermove", (event) => {
      this.hovered = event.offsetX;
      this.draw();
    });
    canvas.addEventListener("pointerleave", () => {
      this.hovered = null;
      this.draw();
    });
  }

  set(points: Curve, others: Curve[]): void {
    // The canvas has another number of pixels on another screen.
    const shown = JSON.stringify([points, others, devicePixelRatio]);
    if (shown === this.shown) return;
    this.shown = shown;
    this.points = finite(points);
    this.others = others.map(finite).filter((curve) => curve.length > 0);
    this.draw();
  }

  private draw(): void {
    const { canvas } = this;
    const { width, height } = this.sizePx;
    const context = canvas.getContext("2d");
    if (!context || width === 0) return;
    canvas.width = Math.round(width * devicePixelRatio);
    canvas.height = Math.round(height * devicePixelRatio);
    context.scale(devicePixelRatio, devicePixelRatio);
    const style = getComputedStyle(document.documentElement);
    const color = (name: string): string => style.getPropertyValue(name).trim();
    context.font = `11px ${style.fontFamily}`;
    if (this.points.length === 0) {
      context.fillStyle = color("--dim");
      context.textAlign = "center";
      context.fillText("after the first evaluation", width / 2, height / 2);
      return;
    }
    const all = [this.points, ...this.others];
    const xMax = Math.max(1, ...all.map((curve) => curve[curve.length - 1]![0]));
    const [yMin, yMax] = spanOf(all.flat().map((point) => point[1]));
    const x = (value: number): number => MARGIN.left + (value / xMax) * (width - MARGIN.left - MARGIN.right);
    const y = (value: number): number =>
      height - MARGIN.bottom - ((value - yMin) / (yMax - yMin)) * (height - MARGIN.top - MARGIN.bottom);

    context.lineWidth = 1;
    context.strokeStyle = color("--line");
    context.fillStyle = color("--dim");
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const tick of ticks(yMin, yMax, 4)) {
      line(context, [[MARGIN.left, y(tick)], [width - MARGIN.right, y(tick)]]);
      context.fillText(String(tick), MARGIN.left - 6, y(tick));
    }
    context.textBaseline = "alphabetic";
    for (const tick of timeTicks(xMax, Math.floor((width - MARGIN.left - MARGIN.right) / MIN_TICK_PX))) {
      context.textAlign = x(tick) > width - 24 ? "right" : tick === 0 ? "left" : "center";
      context.fillText(timeText(tick), x(tick), height - 4);
    }

    const pathOf = (curve: Curve) => curve.map(([seconds, psnr]) => [x(seconds), y(psnr)] as const);
    context.lineJoin = "round";
    context.strokeStyle = color("--dim");
    for (const other of this.others) line(context, pathOf(other));
    const path = pathOf(this.points);
    context.strokeStyle = color("--accent");
    context.lineWidth = 1.75;
    line(context, path);
    const selected = this.nearest(x) ?? this.points.length - 1;
    this.mark(context, path[selected]!, this.points[selected]!, color);
  }

  /** Index of the point under the pointer. */
  private nearest(x: (seconds: number) => number): number | null {
    const pointer = this.hovered;
    if (pointer === null) return null;
    let best = 0;
    this.points.forEach(([seconds], ix) => {
      if (Math.abs(x(seconds) - pointer) < Math.abs(x(this.points[best]![0]) - pointer)) best = ix;
    });
    return best;
  }

  private mark(
    context: CanvasRenderingContext2D,
    [px, py]: readonly [number, number],
    [seconds, psnr]: Curve[number],
    color: (name: string) => string,
  ): void {
    context.fillStyle = color("--accent");
    context.beginPath();
    context.arc(px, py, 3.5, 0, 2 * Math.PI);
    context.fill();
    if (this.hovered === null) return;
    const text = `${psnr.toFixed(2)} dB at ${timeText(seconds)}`;
    const half = context.measureText(text).width / 2;
    const middle = Math.min(Math.max(px, MARGIN.left + half), this.sizePx.width - MARGIN.right - half);
    const above = py > 30 ? py - 12 : py + 20;
    context.fillStyle = color("--raised");
    context.fillRect(middle - half - 4, above - 11, 2 * half + 8, 15);
    context.fillStyle = color("--text");
    context.textAlign = "center";
    context.fillText(text, middle, above);
  }
}

function finite(curve: Curve): Curve {
  return curve.filter(([seconds, psnr]) => Number.isFinite(seconds) && Number.isFinite(psnr));
}

function line(context: CanvasRenderingContext2D, points: readonly (readonly [number, number])[]): void {
  context.beginPath();
  points.forEach(([px, py], ix) => {
    if (ix === 0) context.moveTo(px, py);
    else context.lineTo(px, py);
  });
  context.stroke();
}

/** Range of the values with some padding; wide enough that a flat, noisy curve looks flat. */
function spanOf(values: number[]): [number, number] {
  const min = Math.min(...values);
  const max = Math.max(...values);
  const padding = Math.max(0.06 * (max - min), (MIN_SPAN_DB - (max - min)) / 2, 0.1);
  return [min - padding, max + padding];
}

/** Round numbers between two values, about `n` of them. */
function ticks(min: number, max: number, n: number): number[] {
  const rough = (max - min) / n;
  const power = 10 ** Math.floor(Math.log10(rough));
  const size = [1, 2, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= 0.8 * rough)!;
  const found = [];
  for (let ix = Math.ceil(min / size); ix * size <= max; ix += 1) found.push(Number((ix * size).toPrecision(6)));
  return found;
}

/** Times on the axis of a chart. Whole minutes have short labels. */
function timeTicks(max: number, n: number): number[] {
  if (max < 150) return ticks(0, max, n);
  return ticks(0, max / 60, n).filter(Number.isInteger).map((minutes) => 60 * minutes);
}
