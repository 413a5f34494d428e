// The keys that move the eye while flying. They have no other meaning then.

/** Directions of keys by their position on the keyboard: right, up, forward. */
export const MOVEMENTS: Record<string, [number, number, number]> = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyE: [0, 1, 0],
  KeyQ: [0, -1, 0],
  ArrowUp: [0, 0, 1],
  ArrowDown: [0, 0, -1],
  ArrowLeft: [-1, 0, 0],
  ArrowRight: [1, 0, 0],
};

/** Whether a key, in lower case and on an English keyboard, moves the eye. */
export function isMovementKey(key: string): boolean {
  return Object.keys(MOVEMENTS).some((code) => code.replace("Key", "").toLowerCase() === key);
}
