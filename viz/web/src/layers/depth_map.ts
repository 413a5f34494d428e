// Depth of the model as seen from a point, in one picture or in all directions.

import { type Matrix4, Vector3 } from "three";
import { type PosedDepth, pixelAt } from "../view/surface_picker";

/** Free space around a point, where known. */
export interface DepthMap {
  /** The point from which the surfaces were seen. */
  readonly origin: Vector3;
  /** Whether surfaces are known in all directions. */
  readonly isComplete: boolean;
  /** No surface is closer to the origin than this; negative infinity if that is not known in all directions. */
  readonly nearestM: number;
  /**
   * Distance of a point in front of the surface in its direction, meters. Negative behind the
   * surface, infinite if there is no surface.
   */
  clearance(point: Vector3): number;
  /**
   * The largest clearance within the resolution of the map. It is negative only if the point is
   * certainly behind a surface.
   */
  largestClearance(point: Vector3): number;
  /** The smallest clearance within the resolution of the map. If it is positive, the point is certainly in front. */
  smallestClearance(point: Vector3): number;
  /** Whether most surfaces around the origin are closer than this. */
  isWithin(distanceM: number): boolean;
}

/** The part of the model in a picture. */
export class PictureDepthMap implements DepthMap {
  readonly origin: Vector3;
  readonly isComplete = false;
  readonly nearestM = -Infinity;
  private readonly pictureFromWorld: Matrix4;

  constructor(private readonly posed: PosedDepth) {
    this.origin = new Vector3().setFromMatrixPosition(posed.worldFromPicture);
    this.pictureFromWorld = posed.worldFromPicture.clone().invert();
  }

  clearance(point: Vector3): number {
    return this.behind(point, 0);
  }

  largestClearance(point: Vector3): number {
    return this.behind(point, 1);
  }

  smallestClearance(point: Vector3): number {
    return this.behind(point, 1, Math.min);
  }

  private behind(point: Vector3, reach: number, choose = Math.max): number {
    const inPicture = point.clone().applyMatrix4(this.pictureFromWorld);
    const pixel = pixelAt(this.posed, inPicture);
    return pixel ? surface(this.posed.depth, this.posed.depthSizePx, pixel, reach, choose) - inPicture.z : Infinity;
  }

  isWithin(): boolean {
    return false; // A picture may show a single object.
  }
}

/** The model in all directions, from an equirectangular picture. */
export class PanoramaDepthMap implements DepthMap {
  readonly origin: Vector3;
  readonly isComplete = true;
  readonly nearestM: number;
  private readonly pictureFromWorld: Matrix4;

  constructor(
    worldFromPicture: Matrix4,
    private readonly depth: Float32Array,
    private readonly sizePx: [number, number],
  ) {
    this.origin = new Vector3().setFromMatrixPosition(worldFromPicture);
    this.pictureFromWorld = worldFromPicture.clone().invert();
    this.nearestM = depth.reduce((nearest, depthM) => (depthM > 0 ? Math.min(nearest, depthM) : nearest), Infinity);
  }

  clearance(point: Vector3): number {
    return this.behind(point, 0);
  }

  largestClearance(point: Vector3): number {
    return this.behind(point, 1);
  }

  smallestClearance(point: Vector3): number {
    return this.behind(point, 1, Math.min);
  }

  private behind(point: Vector3, reach: number, choose = Math.max): number {
    const { x, y, z } = point.clone().applyMatrix4(this.pictureFromWorld);
    const distance = Math.hypot(x, y, z);
    if (distance === 0) return Infinity;
    const [width, height] = this.sizePx;
    const column = Math.min(width - 1, Math.floor((0.5 + Math.atan2(x, z) / (2 * Math.PI)) * width));
    const row = Math.min(height - 1, Math.floor((0.5 + Math.asin(y / distance) / Math.PI) * height));
    return surface(this.depth, this.sizePx, [column, row], reach, choose) - distance;
  }

  isWithin(distanceM: number): boolean {
    const [width, height] = this.sizePx;
    let near = 0;
    let all = 0;
    this.depth.forEach((depth, ix) => {
      const area = Math.cos(((Math.floor(ix / width) + 0.5) / height - 0.5) * Math.PI);
      all += area;
      if (depth > 0 && depth < distanceM) near += area;
    });
    return near > 0.5 * all;
  }
}

/** Largest or smallest depth of a pixel and of its neighbors at this distance; without a surface, depth is infinite. */
function surface(
  depth: Float32Array,
  [width, height]: [number, number],
  [x, y]: [number, number],
  reach: number,
  choose: (a: number, b: number) => number,
): number {
  let chosen = depth[y * width + x] || Infinity;
  for (let row = Math.max(0, y - reach); row <= Math.min(height - 1, y + reach); row++) {
    for (let column = Math.max(0, x - reach); column <= Math.min(width - 1, x + reach); column++) {
      chosen = choose(chosen, depth[row * width + column] || Infinity);
    }
  }
  return chosen;
}
