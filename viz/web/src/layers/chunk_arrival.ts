// How much of a model has arrived in chunks, and whether that is enough to draw a view without holes.

import type { ModelChunkHeader } from "../connection/protocol";

/** The part of a chunk's header that counts chunks. */
export type ChunkCounts = Pick<
  ModelChunkHeader,
  "id" | "is_coarse" | "n_chunks" | "n_incomplete" | "n_unsent" | "n_incomplete_in_view" | "n_unsent_in_view"
>;

export class ChunkArrival {
  /** Number of chunks of the model. */
  nChunks = 0;
  /** Number of chunks that are missing or coarse. */
  nIncomplete = 0;
  private nMissing = 0;
  private nMissingInView = 0;
  private nIncompleteInView = 0;
  private hasEverything = false;
  private readonly received = new Set<number>();

  /** To be called when a chunk can be drawn. */
  add(counts: ChunkCounts): void {
    this.received.add(counts.id);
    this.nChunks = counts.n_chunks;
    this.nIncomplete = counts.n_incomplete;
    // Older servers do not distinguish missing chunks from coarse ones, and do not report on the view.
    this.nMissing = counts.n_unsent ?? counts.n_incomplete;
    // Without a view, the server cannot count the chunks in view.
    this.nMissingInView = counts.n_unsent_in_view ?? this.nMissing;
    this.nIncompleteInView = counts.n_incomplete_in_view ?? counts.n_incomplete;
    if (this.nMissing === 0 && this.hasAllSent) this.hasEverything = true;
  }

  remove(ids: number[]): void {
    for (const id of ids) this.received.delete(id);
  }

  /**
   * Whether each chunk has arrived at some time, at least in its coarse form. Later chunks replace
   * earlier ones without holes.
   */
  get hasAll(): boolean {
    return this.hasEverything;
  }

  /** Whether the view of the last picture request can be drawn without holes. */
  get coversView(): boolean {
    return this.hasEverything || (this.hasAllSent && this.nMissingInView === 0);
  }

  /** Whether the view of the last picture request can be drawn in full detail. */
  get completesView(): boolean {
    return this.coversView && this.nIncompleteInView === 0;
  }

  /**
   * Whether all chunks have arrived that the server counts as sent. A message for an earlier
   * subscription may arrive after the page has discarded its chunks. Such a message counts chunks
   * that the page does not have.
   */
  private get hasAllSent(): boolean {
    return this.nChunks > 0 && this.received.size >= this.nChunks - this.nMissing;
  }
}
