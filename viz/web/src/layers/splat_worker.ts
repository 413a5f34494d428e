// The worker that sorts splats.

import { type FreeUnits, type SetChunk, type Sort, type SortAround, type SortResult, SplatSorter } from "./splat_sorter";

const sorter = new SplatSorter();

self.onmessage = ({ data }: MessageEvent<SetChunk | FreeUnits | Sort | SortAround>): void => {
  if (data.kind === "set") sorter.set(data);
  else if (data.kind === "free") sorter.free(data);
  else {
    const result: SortResult = data.kind === "sort" ? { order: sorter.sort(data) } : sorter.sortAround(data);
    self.postMessage(result, { transfer: [result.order.buffer] });
  }
};
