// The list of keyframes, kept up to date by changes.

import type { KeyframeChanges, NumberedKeyframe } from "../connection/protocol";

export class KeyframeList {
  private readonly byNumber = new Map<number, NumberedKeyframe>();

  /** Applies changes; a message from version 0 replaces the list. */
  apply(changes: KeyframeChanges): void {
    if (changes.from_version === 0) this.byNumber.clear();
    for (const keyframe of changes.keyframes) this.byNumber.set(keyframe.id, keyframe);
    for (const number of changes.removed) this.byNumber.delete(number);
  }

  get keyframes(): NumberedKeyframe[] {
    return [...this.byNumber.values()];
  }
}
