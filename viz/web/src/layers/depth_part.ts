// Decodes the depth of a picture.

import { decodeCompactDepth } from "./compact_depth";
import type { DepthPart } from "../connection/protocol";

/** Depth by pixel, row by row, meters; 0 means no surface. */
export interface DepthImage {
  depth: Float32Array<ArrayBuffer>;
  sizePx: [number, number];
}

/** The depth in the payload of a picture. */
export async function decodeDepth(part: DepthPart, payload: Uint8Array<ArrayBuffer>): Promise<DepthImage> {
  // The parts are packed without padding; a copy gives them the alignment that typed arrays need.
  const bytes = payload.slice(part.offset, part.offset + part.bytes);
  if (part.format === "compact_half") {
    return { depth: await decodeCompactDepth(bytes, part.size_px, part.min_m, part.log_step), sizePx: part.size_px };
  }
  const counts = part.format === "f32" ? new Float32Array(bytes.buffer) : new Uint16Array(bytes.buffer);
  return { depth: Float32Array.from(counts, (count) => count * part.meters_per_count), sizePx: part.size_px };
}
