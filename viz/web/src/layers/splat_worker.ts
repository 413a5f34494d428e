// The worker that sorts splats.

import { type FreeUnits, type SetChunk, type Sort, type SortResult, SplatSorter } from "./splat_sorter";

const sorter = new SplatSorter();

self.onmessage = ({ data }: MessageEvent<SetChunk | FreeUnits | Sort>): void => {
  if (data.kind === "set") sorter.set(data);
  else if (data.kind === "free") sorter.free(data);
  else {
    const result: SortResult = { order: sorter.sort(data) };
    self.postMessage(result, { transfer: [result.order.buffer] });
  }
};
