// Estimates how many pixels splats cover, which is most of the cost of drawing them. This file has no DOM.

/** The lens of an eye, and its size. */
export interface FillLens {
  sizePx: [number, number];
  focalPx: [number, number];
  principalPx: [number, number];
  nearM: number;
}

/**
 * Squares of the radii, in standard deviations, at which splats can be cut off. The first one is that of a splat with full
 * opacity, whose density falls to 1/255 there.
 */
export const EXTENTS: readonly number[] = [2 * Math.log(255), 8, 5, 4];

/** The low-pass filter of the shader, pixels squared. */
const LOW_PASS_PX2 = 0.3;
/** Exponent of Thomsen's approximation of the surface of an ellipsoid (2004), whose error is at most 1.1 %. */
const EXPONENT = 1.6075;

/**
 * Mean area of the shadow of an ellipsoid over all directions of the light: a quarter of its surface (Cauchy 1841).
 * `scales`: its half axes.
 */
export function meanShadow([a, b, c]: readonly [number, number, number]): number {
  const sum = (a * b) ** EXPONENT + (a * c) ** EXPONENT + (b * c) ** EXPONENT;
  return Math.PI * (sum / 3) ** (1 / EXPONENT);
}

/** Square of the radius to which the shader draws a splat of this opacity, 0 to 255, in standard deviations. */
export function reachOf(alpha: number): number {
  return alpha > 1 ? 2 * Math.log(alpha) : 0;
}

/** Pixels that splats cover in a view, for each of the extents. */
export class FillSum {
  readonly coveredPx = EXTENTS.map(() => 0);
  private readonly focalPx2: number;
  private readonly wholePx: number;

  constructor(private readonly lens: FillLens) {
    this.focalPx2 = lens.focalPx[0] * lens.focalPx[1];
    this.wholePx = lens.sizePx[0] * lens.sizePx[1];
  }

  /**
   * Adds a splat at a point of the camera's frame: x right, y down, z forward. `shadowM2`: see `meanShadow`, with standard
   * deviations as half axes.
   */
  add(x: number, y: number, z: number, shadowM2: number, reach: number): void {
    const { lens } = this;
    if (z < lens.nearM || reach <= 0) return;
    const u = (lens.focalPx[0] * x) / z + lens.principalPx[0];
    const v = (lens.focalPx[1] * y) / z + lens.principalPx[1];
    const variancePx2 = (shadowM2 * this.focalPx2) / (Math.PI * z * z) + LOW_PASS_PX2;
    const radiusPx = Math.sqrt(reach * variancePx2);
    const [width, height] = lens.sizePx;
    const columns = overlap(u, radiusPx, width);
    const rows = overlap(v, radiusPx, height);
    if (columns <= 0 || rows <= 0) return;
    // The fraction of the surrounding square that is in the picture; a disk fills pi/4 of its square.
    const shareInside = (columns * rows) / (4 * radiusPx * radiusPx);
    for (let ix = 0; ix < EXTENTS.length; ix++) {
      const areaPx = Math.PI * Math.min(reach, EXTENTS[ix]!) * variancePx2;
      this.coveredPx[ix]! += Math.min(areaPx * shareInside, this.wholePx);
    }
  }
}

/** Length of the part of an interval around a center that lies between 0 and `size`. */
function overlap(center: number, radius: number, size: number): number {
  return Math.min(center + radius, size) - Math.max(center - radius, 0);
}
