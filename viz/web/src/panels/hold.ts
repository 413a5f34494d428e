// Tells a tap from a touch that holds a control in order to read what it does. This is a decision without DOM.

/** A finger that stays this long asks what the control does. */
export const HOLD_MILLIS = 500;

/** A touch that has ended. The times are those of its events, not of the listeners, which run late on a busy page. */
export interface EndedTouch {
  pressedMillis: number;
  releasedMillis: number;
  /** Whether the page has shown what the control does. Without an answer, people press longer. */
  isAnswered: boolean;
}

/** Whether the touch only asked what the control does. Otherwise, it is a tap, and presses the control. */
export function isHold({ pressedMillis, releasedMillis, isAnswered }: EndedTouch): boolean {
  return isAnswered && releasedMillis - pressedMillis >= HOLD_MILLIS;
}
