// Finds the place of the model that is seen worst, and describes how to turn and move a camera toward it. The page loads
// this script when the operator asks for the place.

import type { ObservationsHeader, Scene } from "../connection/protocol";

export { cameraToTurn, eyeFor } from "./coverage_cameras";

/** When and how precisely each cell of a grid was observed: codes of ages, then codes of standard deviations. */
export interface ObservationCodes {
  header: ObservationsHeader;
  codes: Uint8Array;
}

export interface WorstPlace {
  /** Center of the part of the model whose cells were compared with those of other parts, in world. */
  centerM: [number, number, number];
  pointM: [number, number, number];
  /** Standard deviation of the position of the surface, meters; null if it is not determined. */
  sigmaM: number | null;
  /** Time from the last keyframe that shows the place to the newest keyframe. */
  ageSecs: number;
}

/** Where a place is, as seen from a camera. */
export interface Direction {
  /** Angle about the vertical, to the right if positive; null if the place is straight above or below. */
  rightRad: number | null;
  upM: number;
  distanceM: number;
}

/** Standard deviations below the first value are good enough. Above the second value, the place is hardly known. */
const GOOD_SIGMA_M = 1e-3;
const BAD_SIGMA_M = 1e-1;
/**
 * The same limits for ages. Old places count half as much as unknown places, because usually
 * nothing has changed there.
 */
const RECENT_SECS = 30;
const OLD_SECS = 600;
const AGE_WEIGHT = 0.5;
/** Size of the compared places, in radii of the scene. It is about the area that a camera sees from nearby. */
const PLACE_RADII = 0.12;
/**
 * A place is kept until its cells are seen better, in sum, than this share of the worst ones. Otherwise, the place would
 * change while the operator drives to it.
 */
const KEPT_SHARE = 0.5;
/** Cells farther from the center of the scene than this, in its radii, are out of reach. */
const REACH_RADII = 1;
const UNOBSERVED = 0;
const UNDETERMINED = 255;

/**
 * The place whose cells are seen worst in sum; null if all cells are seen well. The place that was found before stays
 * as long as it is hardly better than the worst one.
 */
export function worstPlace(
  { header, codes }: ObservationCodes,
  scene: Pick<Scene, "center_m" | "radius_m">,
  found: WorstPlace | null = null,
): WorstPlace | null {
  const [width, height, depth] = header.n_cells;
  const nCells = width * height * depth;
  if (codes.length < 2 * nCells) return null;
  const weights = cellWeights({ header, codes }, scene);
  const reachCells = Math.max(1, Math.round((PLACE_RADII * scene.radius_m) / header.cell_m));
  const sums = boxSums(weights, header.n_cells, reachCells);
  const worst = indexOfMax(sums);
  if (!(sums[worst]! > 0)) return null;
  const foundIx = found && cellAt(header, found.centerM);
  const isKept = foundIx !== null && sums[foundIx]! >= KEPT_SHARE * sums[worst]!;
  const center = isKept ? foundIx : worst;
  const pointIx = isKept ? cellAt(header, found!.pointM) : null;
  const isPointKept = pointIx !== null && weights[pointIx]! > 0;
  const ix = isPointKept ? pointIx : weightedCell(weights, header.n_cells, center, reachCells);
  const sigmaCode = codes[nCells + ix]!;
  return {
    centerM: isKept ? found!.centerM : cellCenter(header, center),
    pointM: isPointKept ? found!.pointM : cellCenter(header, ix),
    sigmaM: sigmaCode === UNDETERMINED ? null : decoded(header.min_sigma_m, header.log_step, sigmaCode),
    ageSecs: decoded(header.min_age_secs, header.log_step, codes[ix]!),
  };
}

/** How badly each cell is seen, 0 to 1. Cells that were never observed are mostly empty space. */
function cellWeights({ header, codes }: ObservationCodes, scene: Pick<Scene, "center_m" | "radius_m">): Float32Array {
  const nCells = header.n_cells[0] * header.n_cells[1] * header.n_cells[2];
  const weights = new Float32Array(nCells);
  const sigmaWeights = table((code) => badness(decoded(header.min_sigma_m, header.log_step, code), GOOD_SIGMA_M, BAD_SIGMA_M));
  // In saved models, ages only show when places were recorded, and not what has changed since then.
  const isLive = header.newest_millis !== null;
  const ageWeights = table((code) =>
    isLive ? AGE_WEIGHT * badness(decoded(header.min_age_secs, header.log_step, code), RECENT_SECS, OLD_SECS) : 0,
  );
  ageWeights[UNDETERMINED] = isLive ? AGE_WEIGHT : 0;
  for (let ix = 0; ix < nCells; ix++) {
    const sigmaCode = codes[nCells + ix]!;
    if (sigmaCode === UNOBSERVED) continue;
    const [x, y, z] = cellCenter(header, ix);
    const [centerX, centerY, centerZ] = scene.center_m;
    if (Math.hypot(x - centerX, y - centerY, z - centerZ) > REACH_RADII * scene.radius_m) continue;
    weights[ix] = Math.max(sigmaWeights[sigmaCode]!, ageWeights[codes[ix]!]!);
  }
  return weights;
}

function table(weight: (code: number) => number): Float32Array {
  const made = Float32Array.from({ length: 256 }, (_, code) => (code === UNOBSERVED ? 0 : weight(code)));
  made[UNDETERMINED] = 1;
  return made;
}

function decoded(min: number, logStep: number, code: number): number {
  return min * Math.exp(logStep * (code - 1));
}

/** Position of a value between a good and a bad one, on a logarithmic scale, 0 to 1. */
function badness(value: number, good: number, bad: number): number {
  return Math.min(1, Math.max(0, Math.log(value / good) / Math.log(bad / good)));
}

/** Center of a cell in world. */
function cellCenter({ min_m, cell_m, n_cells }: ObservationsHeader, ix: number): [number, number, number] {
  const [width, height] = n_cells;
  const [x, y, z] = [ix % width, Math.floor(ix / width) % height, Math.floor(ix / (width * height))];
  return [min_m[0] + cell_m * (x + 0.5), min_m[1] + cell_m * (y + 0.5), min_m[2] + cell_m * (z + 0.5)];
}

/** The cell that contains a point in world; null outside of the grid. */
function cellAt({ min_m, cell_m, n_cells }: ObservationsHeader, pointM: [number, number, number]): number | null {
  const [x, y, z] = pointM.map((value, axis) => Math.floor((value - min_m[axis]!) / cell_m)) as [number, number, number];
  const isInside = [x, y, z].every((at, axis) => at >= 0 && at < n_cells[axis]!);
  return isInside ? (z * n_cells[1] + y) * n_cells[0] + x : null;
}

/** Sums over cubes of `2 * reach + 1` cells around each cell, one axis after the other. */
function boxSums(weights: Float32Array, nCells: [number, number, number], reach: number): Float32Array {
  let sums = weights;
  let stride = 1;
  for (const length of nCells) {
    sums = sumsAlong(sums, length, stride, reach);
    stride *= length;
  }
  return sums;
}

function sumsAlong(values: Float32Array, length: number, stride: number, reach: number): Float32Array {
  const sums = new Float32Array(values.length);
  for (let start = 0; start < values.length; start++) {
    if (Math.floor(start / stride) % length !== 0) continue;
    let sum = 0;
    for (let step = -reach; step < length; step++) {
      if (step + reach < length) sum += values[start + (step + reach) * stride]!;
      if (step - reach - 1 >= 0) sum -= values[start + (step - reach - 1) * stride]!;
      if (step >= 0) sums[start + step * stride] = sum;
    }
  }
  return sums;
}

function indexOfMax(values: Float32Array): number {
  let best = 0;
  for (let ix = 1; ix < values.length; ix++) if (values[ix]! > values[best]!) best = ix;
  return best;
}

/**
 * The cell with a weight that is closest to the weighted mean around a cell. The mean itself may
 * lie in empty space.
 */
function weightedCell(weights: Float32Array, nCells: [number, number, number], center: number, reach: number): number {
  const [width, height] = nCells;
  const middle = [center % width, Math.floor(center / width) % height, Math.floor(center / (width * height))];
  const low = middle.map((at) => Math.max(0, at - reach)) as [number, number, number];
  const high = middle.map((at, axis) => Math.min(nCells[axis]! - 1, at + reach)) as [number, number, number];
  const cells: { ix: number; at: [number, number, number]; weight: number }[] = [];
  for (let z = low[2]; z <= high[2]; z++) {
    for (let y = low[1]; y <= high[1]; y++) {
      for (let x = low[0]; x <= high[0]; x++) {
        const ix = (z * height + y) * width + x;
        if (weights[ix]! > 0) cells.push({ ix, at: [x, y, z], weight: weights[ix]! });
      }
    }
  }
  const total = cells.reduce((sum, { weight }) => sum + weight, 0);
  const mean = [0, 1, 2].map((axis) => cells.reduce((sum, { at, weight }) => sum + at[axis]! * weight, 0) / total);
  const distance = ({ at }: { at: number[] }): number => Math.hypot(...at.map((value, axis) => value - mean[axis]!));
  return cells.reduce((best, cell) => (distance(cell) < distance(best) ? cell : best)).ix;
}

/** Where a point in world is, as seen from a camera: x right, y down, z forward; the pose is row major. */
export function directionTo([x, y, z]: readonly [number, number, number], worldFromCamera: readonly number[]): Direction {
  const [toX, toY, upM] = [x - worldFromCamera[3]!, y - worldFromCamera[7]!, z - worldFromCamera[11]!];
  const distanceM = Math.hypot(toX, toY, upM);
  const [aheadX, aheadY] = heading(worldFromCamera);
  // A place that is almost vertically above or below has no useful azimuth.
  if (Math.hypot(toX, toY) < 0.1 * distanceM) return { rightRad: null, upM, distanceM };
  const leftRad = Math.atan2(aheadX * toY - aheadY * toX, aheadX * toX + aheadY * toY);
  return { rightRad: -leftRad, upM, distanceM };
}

/** Horizontal direction in which a camera looks. If it looks down or up, that is the upper or the lower side of its image. */
function heading(pose: readonly number[]): [number, number] {
  const [forwardX, forwardY, forwardZ] = [pose[2]!, pose[6]!, pose[10]!];
  if (Math.hypot(forwardX, forwardY) > 0.3) return [forwardX, forwardY];
  const sign = forwardZ < 0 ? -1 : 1;
  return [sign * pose[1]!, sign * pose[5]!];
}

/** Where a place is in world, such as "x 1.2, y -0.4, height 0.6 m". It does not change while the robot moves. */
export function placeText([x, y, z]: readonly [number, number, number]): string {
  return `x ${x.toFixed(1)}, y ${y.toFixed(1)}, height ${z.toFixed(1)} m`;
}

/**
 * The direction, to 5 degrees, as text, such as "turn right 40 degrees, 0.6 m higher, 1.3 m away". The last two give
 * the position: many cameras cannot move up and down.
 */
export function directionText({ rightRad, upM, distanceM }: Direction): string {
  const parts: string[] = [];
  const degrees = rightRad === null ? 0 : 5 * Math.round((rightRad * 36) / Math.PI);
  if (rightRad !== null) {
    parts.push(Math.abs(degrees) < 5 ? "straight ahead" : `turn ${degrees > 0 ? "right" : "left"} ${Math.abs(degrees)} degrees`);
  }
  if (Math.abs(upM) >= 0.05) parts.push(`${Math.abs(upM).toFixed(1)} m ${upM > 0 ? "higher" : "lower"}`);
  return [...parts, `${distanceM.toFixed(1)} m away`].join(", ");
}

/** Why the place should be looked at. */
export function reasonText({ sigmaM, ageSecs }: WorstPlace, isLive: boolean): string {
  if (sigmaM === null) return "seen from too few directions to know where it is";
  if (sigmaM < GOOD_SIGMA_M && isLive) return `not seen for ${Math.round(ageSecs / 60)} min`;
  return `the position of the surface is uncertain by ${sigmaM < 0.01 ? (1000 * sigmaM).toFixed(1) : (1000 * sigmaM).toFixed(0)} mm`;
}
