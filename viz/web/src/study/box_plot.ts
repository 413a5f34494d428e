// Box plots as SVG, drawn like those of the paper: one group of boxes per category, a color and a hatching per condition, means as
// black dotted lines and medians as yellow solid lines.

export interface BoxGroup {
  label: string;
  /** The values of each condition. A condition without values has no box. */
  boxes: number[][];
}

export interface BoxPlot {
  title: string;
  /** Name and unit of the values. */
  axis: string;
  /** Names of the conditions. */
  legend: string[];
  groups: BoxGroup[];
  /** Smallest and largest value of the axis. */
  range: [number, number];
}

/** Quartiles by linear interpolation, and whiskers to the last values within 1.5 times the distance of the quartiles (Tukey 1977). */
export interface Box {
  lower: number;
  median: number;
  upper: number;
  mean: number;
  whiskers: [number, number];
  outliers: number[];
}

const WIDTH = 900;
const LEFT = 60;
const TOP = 40;
const PLOT_HEIGHT = 270;
const N_TICKS = 5;
const N_LEGEND_COLUMNS = 2;
const LEGEND_ROW = 22;
/** Part of the width of a group that its boxes take. */
const FILLED_FRAC = 0.8;
/** The colors of the paper's figure in its order, and further ones. */
const COLORS = ["#4c9f70", "#4c78a8", "#f58518", "#d64545", "#9467bd", "#8c564b", "#7f7f7f", "#17becf"];
/** Hatchings, as lines in a cell of 8 by 8. */
const HATCHES = ["M4 0V8", "M0 8L8 0", "M0 0L8 8", "M0 4H8", "M0 4H8M4 0V8", "M0 0L8 8M0 8L8 0", "", "M2 0V8M6 0V8"];

export function boxOf(values: readonly number[]): Box | null {
  const sorted = values.filter(Number.isFinite).sort((a, b) => a - b);
  if (sorted.length === 0) return null;
  const [lower, median, upper] = [0.25, 0.5, 0.75].map((frac) => quantile(sorted, frac)) as [number, number, number];
  const reach = 1.5 * (upper - lower);
  const inside = sorted.filter((value) => value >= lower - reach && value <= upper + reach);
  return {
    lower,
    median,
    upper,
    mean: sorted.reduce((sum, value) => sum + value, 0) / sorted.length,
    whiskers: [inside[0]!, inside[inside.length - 1]!],
    outliers: sorted.filter((value) => value < lower - reach || value > upper + reach),
  };
}

/** A quantile of sorted values by linear interpolation, as in NumPy. */
function quantile(sorted: readonly number[], frac: number): number {
  const at = frac * (sorted.length - 1);
  const [low, high] = [sorted[Math.floor(at)]!, sorted[Math.ceil(at)]!];
  return low + (high - low) * (at - Math.floor(at));
}

/** The chart as an SVG file. */
export function boxPlot({ title, axis, legend, groups, range: [min, max] }: BoxPlot): string {
  const y = (value: number): number => TOP + PLOT_HEIGHT * (1 - (value - min) / (max - min));
  const plotWidth = WIDTH - LEFT - 20;
  const groupWidth = plotWidth / groups.length;
  const boxWidth = (FILLED_FRAC * groupWidth) / legend.length;
  const ticks = Array.from({ length: N_TICKS }, (_, ix) => min + ((max - min) * ix) / (N_TICKS - 1));
  const axisLines = ticks.map((tick) => {
    const at = fixed(y(tick));
    return `<path d="M${LEFT} ${at}H${LEFT + plotWidth}" stroke="#ddd"/><text x="${LEFT - 8}" y="${at}" dy="4" text-anchor="end">${Number(tick.toFixed(1))}</text>`;
  });
  const drawn = groups.flatMap(({ label, boxes }, groupIx) => {
    const left = LEFT + groupIx * groupWidth;
    const name = `<text x="${fixed(left + groupWidth / 2)}" y="${TOP + PLOT_HEIGHT + 20}" text-anchor="middle">${escaped(label)}</text>`;
    const start = left + (0.5 - 0.5 * FILLED_FRAC) * groupWidth;
    return [name, ...boxes.map((values, ix) => boxShape(boxOf(values), ix, start + (ix + 0.5) * boxWidth, 0.7 * boxWidth, y))];
  });
  const height = TOP + PLOT_HEIGHT + 70 + LEGEND_ROW * Math.ceil(legend.length / N_LEGEND_COLUMNS);
  const names = legend.map((name, ix) => {
    const x = LEFT + (ix % N_LEGEND_COLUMNS) * (plotWidth / N_LEGEND_COLUMNS);
    const top = TOP + PLOT_HEIGHT + 40 + LEGEND_ROW * Math.floor(ix / N_LEGEND_COLUMNS);
    return `${swatch(ix, fixed(x), fixed(top), 20, 12)}<text x="${fixed(x + 28)}" y="${fixed(top + 11)}">${escaped(name)}</text>`;
  });
  const note = `<text x="${LEFT}" y="${height - 10}" fill="#555">yellow: median, dotted: mean, box: quartiles, whiskers: within 1.5 times their distance, n = ${nOf(groups)}</text>`;
  return [
    `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${WIDTH} ${height}" font-family="sans-serif" font-size="13">`,
    `<defs>${legend.map((_, ix) => hatch(ix)).join("")}</defs><rect width="${WIDTH}" height="${height}" fill="#fff"/>`,
    `<text x="${LEFT}" y="22" font-size="15" font-weight="bold">${escaped(title)}</text>`,
    `<text transform="translate(16 ${TOP + PLOT_HEIGHT / 2}) rotate(-90)" text-anchor="middle">${escaped(axis)}</text>`,
    ...axisLines,
    ...drawn,
    ...names,
    note,
    "</svg>\n",
  ].join("\n");
}

function boxShape(box: Box | null, ix: number, center: number, width: number, y: (value: number) => number): string {
  if (!box) return "";
  const [left, right] = [center - width / 2, center + width / 2].map(fixed) as [string, string];
  const line = (value: number, style: string): string => `<path d="M${left} ${fixed(y(value))}H${right}" ${style}/>`;
  const middle = fixed(center);
  const whisker = (from: number, to: number): string =>
    `<path d="M${middle} ${fixed(y(from))}V${fixed(y(to))}M${fixed(center - width / 4)} ${fixed(y(to))}h${fixed(width / 2)}" stroke="#333" fill="none"/>`;
  const outliers = box.outliers.map((value) => `<circle cx="${middle}" cy="${fixed(y(value))}" r="2.5" fill="none" stroke="#333"/>`);
  // A box without height, as of a single value, still shows its color.
  const height = Math.max(2, y(box.lower) - y(box.upper));
  return [
    `<g class="box" data-median="${fixed(box.median)}" data-mean="${fixed(box.mean)}">`,
    whisker(box.lower, box.whiskers[0]),
    whisker(box.upper, box.whiskers[1]),
    swatch(ix, left, fixed((y(box.upper) + y(box.lower) - height) / 2), width, height),
    line(box.mean, 'stroke="#000" stroke-width="2" stroke-dasharray="2 2"'),
    line(box.median, 'stroke="#ffd400" stroke-width="3"'),
    ...outliers,
    "</g>",
  ].join("");
}

function swatch(ix: number, x: string, y: string, width: number, height: number): string {
  const size = `x="${x}" y="${y}" width="${fixed(width)}" height="${fixed(height)}"`;
  return `<rect ${size} fill="${COLORS[ix % COLORS.length]}"/><rect ${size} fill="url(#hatch${ix})" stroke="#333"/>`;
}

function hatch(ix: number): string {
  const lines = `<path d="${HATCHES[ix % HATCHES.length]}" stroke="#0006"/>`;
  return `<pattern id="hatch${ix}" width="8" height="8" patternUnits="userSpaceOnUse">${lines}</pattern>`;
}

/** The number of values of each box, if it is the same, otherwise the smallest and the largest. */
function nOf(groups: readonly BoxGroup[]): string {
  const counts = groups.flatMap(({ boxes }) => boxes.map((values) => values.length));
  const [min, max] = [Math.min(...counts), Math.max(...counts)];
  return min === max ? String(min) : `${min} to ${max}`;
}

function fixed(value: number): string {
  return String(Number(value.toFixed(2)));
}

function escaped(text: string): string {
  return text.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;").replaceAll('"', "&quot;");
}
