// The text in the view while there is no picture.

import type { ConnectionState } from "../connection/connection";
import type { Status } from "../connection/protocol";
import { capitalized } from "./sentence";

/** What the page knows about the run before the first picture. */
export interface Knowledge {
  connection: ConnectionState;
  status: Pick<Status, "state" | "progress"> | null;
  /** Whether the browser has lost the WebGL context, so that nothing can be drawn. */
  isContextLost: boolean;
}

export interface SkeletonText {
  title: string;
  detail: string;
  /** Completed part of the present work, 0 to 1; null if it is not known. */
  doneFrac: number | null;
}

/** In these states, the server is drawing the first picture. */
const DRAWS_AT_ONCE = ["training", "viewing", "paused", "finished"];

export function skeletonText({ connection, status, isContextLost }: Knowledge): SkeletonText {
  const plain = (title: string, detail = ""): SkeletonText => ({ title, detail, doneFrac: null });
  if (isContextLost) return plain("Waiting for the graphics context", "the browser has discarded it");
  if (connection === "connecting") return plain("Connecting to the server");
  if (connection === "lost" || connection === "refused") return plain("No connection to the server");
  if (!status || status.state === "") return plain("Connected", "waiting for the state of the run");
  const title = capitalized(status.state);
  if (status.progress) return { title, detail: status.progress.text, doneFrac: status.progress.done_frac };
  return plain(title, DRAWS_AT_ONCE.includes(status.state) ? "drawing the first picture" : "a picture follows");
}

/** What decides whether the view is covered. */
export interface Shown {
  hasPicture: boolean;
  /** Whether a picture has shown anything but the background. */
  hasContent: boolean;
  /** Whether the model has not been started yet. */
  isStartup: boolean;
  isContextLost: boolean;
}

/** Whether there is nothing to see yet. Before the model is started, pictures may show only the background. */
export function isNothingShown({ hasPicture, hasContent, isStartup, isContextLost }: Shown): boolean {
  return isContextLost || !hasPicture || (isStartup && !hasContent);
}
