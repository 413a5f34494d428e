// Compares the photograph of a keyframe with the model's picture of the same view. The result
// describes where and how they differ.

/** An image: sRGB, four bytes per pixel, row by row. `ImageData` is one. */
export interface Pixels {
  readonly width: number;
  readonly height: number;
  readonly data: ArrayLike<number>;
}

/** Which pixels can be compared. */
export interface Comparable {
  /** For each pixel, 0 if the photograph shows nothing that is trained on; null if all pixels count. */
  mask: ArrayLike<number> | null;
  /** For each pixel, 0 if the model has no surface there; null if that is unknown. */
  surface: ArrayLike<number> | null;
}

/** The part of a picture with the largest error. */
export interface WorstRegion {
  /** Such as "upper left". */
  name: string;
  /** Mean difference in brightness, 0 to 1, at equal exposure. */
  meanError: number;
}

export interface KeyframeErrors {
  /** Mean difference of the color channels of each pixel, 0 to 1. It is -1 where the images cannot be compared. */
  map: Float32Array;
  /** PSNR over all compared pixels, dB. */
  psnr: number;
  /** How much brighter the photograph is, in steps of a factor of two; null if it cannot be measured. */
  exposureEv: number | null;
  /** Detail of the photograph relative to the detail of the model's picture; null without texture. */
  detailRatio: number | null;
  /**
   * Displacement of the photograph's content relative to the model's picture, pixels. Null if no
   * shift explains the error.
   */
  shiftPx: [number, number] | null;
  worst: WorstRegion | null;
  /** Fraction of the photograph for which the model has no surface; null if that is unknown. */
  emptyFrac: number | null;
}

/** Pixels below the first linear brightness are mostly noise. Pixels above the second are overexposed. */
const MIN_EXPOSED = 0.01;
const MAX_EXPOSED = 0.9;
/** With fewer samples, a small object would determine the exposure. */
const MIN_SAMPLES = 100;
/** More samples take time, and do not change a median. */
const MAX_SAMPLES = 20_000;
/**
 * Mean Laplacian of brightness below which a picture has no texture. The noise of a good camera is
 * below this value.
 */
const MIN_DETAIL = 0.004;
/**
 * Number of blocks along a side of the picture, in which the worst region is searched. A block is
 * about as large as an object on a table.
 */
const N_BLOCKS = 8;
/**
 * A region is mentioned if its error is at least the first value, and at least the second value
 * times the median error of the blocks.
 */
const MIN_REGION_ERROR = 0.1;
const MIN_REGION_RATIO = 3;
/** Shifts are estimated on images of at most this width, so that shifts of some pixels are below one pixel. */
const SHIFT_WIDTH_PX = 160;
const N_SHIFT_STEPS = 4;
/** Larger differences come from other objects than from a shift. */
const MAX_SHIFT_ERROR = 0.25;
/** A shift explains the error if it removes this fraction of the squared error. */
const MIN_EXPLAINED_FRAC = 0.4;
/** Smaller shifts, in pixels of the small images, are below the accuracy of the estimate. */
const MIN_SHIFT_PX = 0.15;

/** Linear brightness of a color channel with 8 bits. */
const LINEAR = Float32Array.from({ length: 256 }, (_, code) => {
  const value = code / 255;
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
});

/** An image of one channel. */
interface Gray {
  width: number;
  height: number;
  values: Float32Array;
  /** By pixel: whether it can be compared. */
  isValid: Uint8Array;
}

/** Compares two images of the same size. Returns null if no pixel can be compared. */
export function compareKeyframe(photo: Pixels, render: Pixels, { mask, surface }: Comparable): KeyframeErrors | null {
  const nPx = photo.width * photo.height;
  if (render.width !== photo.width || render.height !== photo.height) return null;
  const isValid = flags(nPx, mask);
  const { map, psnr } = difference(photo, render, isValid);
  if (!Number.isFinite(psnr) && psnr !== Infinity) return null;
  const onSurface = flags(nPx, surface);
  for (let ix = 0; ix < nPx; ix++) onSurface[ix]! &= isValid[ix]!;
  const [photoGray, renderGray] = [linearGray(photo, onSurface), linearGray(render, onSurface)];
  const exposureEv = exposure(photoGray, renderGray);
  encode(photoGray, 2 ** -(exposureEv ?? 0));
  encode(renderGray, 1);
  const nValid = count(isValid);
  return {
    map,
    psnr,
    exposureEv,
    detailRatio: detailRatio(photoGray, renderGray),
    shiftPx: shift(photoGray, renderGray),
    worst: worstRegion(photoGray, renderGray),
    emptyFrac: surface === null ? null : 1 - count(onSurface) / nValid,
  };
}

/** Returns 1 for each number above 0. Returns 1 for all pixels if there are no numbers. */
function flags(nPx: number, numbers: ArrayLike<number> | null): Uint8Array {
  const made = new Uint8Array(nPx).fill(1);
  if (numbers) for (let ix = 0; ix < nPx; ix++) made[ix] = numbers[ix]! > 0 ? 1 : 0;
  return made;
}

function difference(photo: Pixels, render: Pixels, isValid: Uint8Array): { map: Float32Array; psnr: number } {
  const map = new Float32Array(isValid.length).fill(-1);
  let [sum, n] = [0, 0];
  for (let ix = 0; ix < isValid.length; ix++) {
    if (!isValid[ix]) continue;
    let total = 0;
    for (let channel = 0; channel < 3; channel++) {
      const error = (photo.data[4 * ix + channel]! - render.data[4 * ix + channel]!) / 255;
      total += Math.abs(error);
      sum += error * error;
    }
    map[ix] = total / 3;
    n += 3;
  }
  return { map, psnr: n === 0 ? NaN : -10 * Math.log10(sum / n) };
}

function linearGray({ width, height, data }: Pixels, isValid: Uint8Array): Gray {
  const values = new Float32Array(width * height);
  for (let ix = 0; ix < values.length; ix++) {
    const red = LINEAR[data[4 * ix]!]!;
    const green = LINEAR[data[4 * ix + 1]!]!;
    const blue = LINEAR[data[4 * ix + 2]!]!;
    values[ix] = 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  }
  return { width, height, values, isValid };
}

/**
 * Multiplies linear brightness by a factor, and takes the square root, which is close to sRGB.
 * Differences are then about as large as they look.
 */
function encode(gray: Gray, factor: number): void {
  const { values } = gray;
  for (let ix = 0; ix < values.length; ix++) values[ix] = Math.sqrt(Math.min(1, values[ix]! * factor));
}

/**
 * Exposure from the median of the logarithm of the ratio. A median is not affected by objects that
 * are only in one of the images.
 */
function exposure(photo: Gray, render: Gray): number | null {
  const ratios: number[] = [];
  const isExposed = (value: number): boolean => value > MIN_EXPOSED && value < MAX_EXPOSED;
  // The step is odd, so that the samples are not in only a few columns.
  const step = 2 * Math.floor(photo.values.length / (2 * MAX_SAMPLES)) + 1;
  for (let ix = 0; ix < photo.values.length; ix += step) {
    const one = photo.values[ix]!;
    const other = render.values[ix]!;
    if (photo.isValid[ix] && isExposed(one) && isExposed(other)) ratios.push(Math.log2(one / other));
  }
  return ratios.length < MIN_SAMPLES ? null : median(ratios);
}

function detailRatio(photo: Gray, render: Gray): number | null {
  const [one, other] = [detail(photo), detail(render)];
  return Math.max(one, other) < MIN_DETAIL ? null : one / Math.max(other, 1e-6);
}

/** Mean absolute Laplacian of the brightness. */
function detail({ width, height, values, isValid }: Gray): number {
  let [sum, n] = [0, 0];
  for (let y = 1; y < height - 1; y++) {
    for (let x = 1; x < width - 1; x++) {
      const ix = y * width + x;
      const areValid = isValid[ix]! & isValid[ix - 1]! & isValid[ix + 1]! & isValid[ix - width]! & isValid[ix + width]!;
      if (!areValid) continue;
      const around = values[ix - 1]! + values[ix + 1]! + values[ix - width]! + values[ix + width]!;
      sum += Math.abs(4 * values[ix]! - around);
      n += 1;
    }
  }
  return n === 0 ? 0 : sum / n;
}

function worstRegion(photo: Gray, render: Gray): WorstRegion | null {
  const { width, height } = photo;
  const sums = new Float64Array(N_BLOCKS * N_BLOCKS);
  const counts = new Float64Array(N_BLOCKS * N_BLOCKS);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const ix = y * width + x;
      if (!photo.isValid[ix]) continue;
      const block = Math.floor((y * N_BLOCKS) / height) * N_BLOCKS + Math.floor((x * N_BLOCKS) / width);
      sums[block]! += Math.abs(photo.values[ix]! - render.values[ix]!);
      counts[block]! += 1;
    }
  }
  // Blocks with few valid pixels, such as at the edge of a mask, say little.
  const isFull = (block: number): boolean => counts[block]! > (0.3 * width * height) / counts.length;
  const blocks = [...sums.keys()].filter(isFull);
  if (blocks.length === 0) return null;
  const error = (block: number): number => sums[block]! / counts[block]!;
  const worst = blocks.reduce((max, block) => (error(block) > error(max) ? block : max));
  const typical = median(blocks.map(error));
  const meanError = error(worst);
  if (meanError < MIN_REGION_ERROR || meanError < MIN_REGION_RATIO * typical) return null;
  return { name: regionName((worst % N_BLOCKS) / N_BLOCKS, Math.floor(worst / N_BLOCKS) / N_BLOCKS), meanError };
}

/** Name of the place of a block whose corner is at these fractions of the width and height. */
function regionName(xFrac: number, yFrac: number): string {
  const third = (frac: number): number => Math.min(2, Math.floor(3 * (frac + 0.5 / N_BLOCKS)));
  const [column, row] = [["left", "", "right"][third(xFrac)]!, ["upper", "", "lower"][third(yFrac)]!];
  if (!column && !row) return "middle";
  if (!column) return `${row} middle`;
  return row ? `${row} ${column}` : `${column} middle`;
}

/**
 * Displacement of the photograph's content relative to the model's picture, on small images (Lucas
 * and Kanade 1981).
 */
function shift(photo: Gray, render: Gray): [number, number] | null {
  const scale = Math.max(1, Math.ceil(photo.width / SHIFT_WIDTH_PX));
  const [target, source] = [shrunk(photo, scale), shrunk(render, scale)];
  let offset: [number, number] = [0, 0];
  const before = shiftStep(target, source, offset);
  let now = before;
  for (let step = 0; step < N_SHIFT_STEPS && now; step++) {
    offset = [offset[0] + now.step[0], offset[1] + now.step[1]];
    now = shiftStep(target, source, offset);
  }
  if (!before || !now || now.meanSquare > (1 - MIN_EXPLAINED_FRAC) * before.meanSquare) return null;
  return Math.hypot(...offset) < MIN_SHIFT_PX ? null : [offset[0] * scale, offset[1] * scale];
}

/** The next step toward the shift, and the mean square error at the present one; null if there is too little texture. */
function shiftStep(
  target: Gray,
  source: Gray,
  [dx, dy]: [number, number],
): { step: [number, number]; meanSquare: number } | null {
  const { width, height } = target;
  let [xx, xy, yy, xr, yr, sum, n] = [0, 0, 0, 0, 0, 0, 0];
  for (let y = 1; y < height - 1; y++) {
    for (let x = 1; x < width - 1; x++) {
      if (!target.isValid[y * width + x]) continue;
      const moved = sample(source, x - dx, y - dy);
      const gradientX = 0.5 * (sample(source, x - dx + 1, y - dy) - sample(source, x - dx - 1, y - dy));
      const gradientY = 0.5 * (sample(source, x - dx, y - dy + 1) - sample(source, x - dx, y - dy - 1));
      const error = target.values[y * width + x]! - moved;
      if (!(Math.abs(error) < MAX_SHIFT_ERROR) || Number.isNaN(gradientX + gradientY)) continue;
      xx += gradientX * gradientX;
      xy += gradientX * gradientY;
      yy += gradientY * gradientY;
      xr -= gradientX * error;
      yr -= gradientY * error;
      sum += error * error;
      n += 1;
    }
  }
  const determinant = xx * yy - xy * xy;
  // Both directions need texture: along a single edge, the shift is not determined.
  if (n < MIN_SAMPLES || !(determinant > 1e-3 * (xx + yy) ** 2)) return null;
  return {
    step: [(yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant],
    meanSquare: sum / n,
  };
}

/** Value between pixels; NaN outside of the image and where it is not valid. */
function sample({ width, height, values, isValid }: Gray, x: number, y: number): number {
  const [left, top] = [Math.floor(x), Math.floor(y)];
  if (left < 0 || top < 0 || left + 1 >= width || top + 1 >= height) return NaN;
  const ix = top * width + left;
  if (!(isValid[ix] && isValid[ix + 1] && isValid[ix + width] && isValid[ix + width + 1])) return NaN;
  const [right, down] = [x - left, y - top];
  const upper = values[ix]! * (1 - right) + values[ix + 1]! * right;
  const lower = values[ix + width]! * (1 - right) + values[ix + width + 1]! * right;
  return upper * (1 - down) + lower * down;
}

/** The image at `1 / scale` of its size. A pixel is valid if all pixels that it covers are valid. */
function shrunk({ width, height, values, isValid }: Gray, scale: number): Gray {
  const small = [Math.floor(width / scale), Math.floor(height / scale)] as const;
  const made: Gray = {
    width: small[0],
    height: small[1],
    values: new Float32Array(small[0] * small[1]),
    isValid: new Uint8Array(small[0] * small[1]).fill(1),
  };
  for (let y = 0; y < small[1] * scale; y++) {
    for (let x = 0; x < small[0] * scale; x++) {
      const at = Math.floor(y / scale) * small[0] + Math.floor(x / scale);
      made.values[at]! += values[y * width + x]! / (scale * scale);
      if (!isValid[y * width + x]) made.isValid[at] = 0;
    }
  }
  return made;
}

function median(values: number[]): number {
  const sorted = Float64Array.from(values).sort();
  return sorted[Math.floor(sorted.length / 2)]!;
}

function count(flags: Uint8Array): number {
  let n = 0;
  for (const flag of flags) n += flag;
  return n;
}
