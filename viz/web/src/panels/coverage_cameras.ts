// Chooses cameras for a place in the scene: the one to turn toward it, and the one from whose pose to look at it.

import type { PosedCamera } from "../connection/protocol";

type Point = readonly [number, number, number];

/** Another camera must need less turning by this. Otherwise, the instruction would change while the robot turns. */
const MUCH_LESS_RAD = Math.PI / 4;
/** A camera that had the place beside or behind its image is used only if it was closer by this factor. */
const BESIDE_FACTOR = 4;
const BEHIND_FACTOR = 16;

/** The camera that needs the least turning, or the previous one if that needs hardly more; null without cameras. */
export function cameraToTurn<C extends Pick<PosedCamera, "camera" | "world_from_camera">>(
  cameras: readonly C[],
  pointM: Point,
  previous: string | null,
): C | null {
  const turnRad = ({ world_from_camera }: C): number => {
    const [x, y, z] = inCamera(world_from_camera, pointM);
    return Math.atan2(Math.hypot(x, y), z);
  };
  const best = least(cameras, turnRad);
  const kept = cameras.find(({ camera }) => camera === previous);
  return kept && turnRad(kept) < turnRad(best!) + MUCH_LESS_RAD ? kept : best;
}

/** The position in world of the closest camera that saw a place or, if none did, of a close one; null without cameras. */
export function eyeFor(cameras: readonly PosedCamera[], pointM: Point): [number, number, number] | null {
  const pose = least(cameras, (camera) => {
    const [x, y, z] = inCamera(camera.world_from_camera, pointM);
    const isInImage = [x, y].every((value, axis) => {
      const px = (camera.focal_px[axis]! * value) / z + camera.principal_px[axis]!;
      return px >= 0 && px <= camera.size_px[axis]!;
    });
    return Math.hypot(x, y, z) * (z <= 0 ? BEHIND_FACTOR : isInImage ? 1 : BESIDE_FACTOR);
  })?.world_from_camera;
  return pose ? [pose[3]!, pose[7]!, pose[11]!] : null;
}

/** A point in world as seen from a camera: x right, y down, z forward; the pose is row major. */
function inCamera(worldFromCamera: readonly number[], pointM: Point): Point {
  const along = (axis: number): number =>
    pointM.reduce((sum, value, row) => sum + worldFromCamera[4 * row + axis]! * (value - worldFromCamera[4 * row + 3]!), 0);
  return [along(0), along(1), along(2)];
}

function least<T>(items: readonly T[], cost: (item: T) => number): T | null {
  const costs = items.map(cost);
  return items[costs.indexOf(Math.min(...costs))] ?? null;
}
