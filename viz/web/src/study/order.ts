// Counter-balanced orders, so that learning and fatigue do not favor a condition.

/**
 * The order of `n` conditions for a participant, counted from 0: a row of a Latin square that is balanced for carry-over
 * effects (Williams 1949). Each condition is at each place equally often, and follows each other condition equally often, after
 * `n` participants if `n` is even, otherwise after `2 n`.
 */
export function balancedOrder(n: number, participant: number): number[] {
  // The first row is 0, n - 1, 1, n - 2, ...: the differences of its neighbors are all different.
  const first = Array.from({ length: n }, (_, place) => (place % 2 === 1 ? n - (place + 1) / 2 : place / 2));
  const row = first.map((condition) => (condition + participant) % n);
  const isReversed = n % 2 === 1 && Math.floor(participant / n) % 2 === 1;
  return isReversed ? row.reverse() : row;
}

/** Number of participants after which orders repeat. */
export function nOrders(n: number): number {
  return n % 2 === 1 && n > 1 ? 2 * n : n;
}

/** The order of `n` tasks in the condition at a place of a participant's order: each task is at each place equally often. */
export function taskOrder(n: number, participant: number, place: number): number[] {
  return Array.from({ length: n }, (_, ix) => (ix + participant + place) % n);
}
