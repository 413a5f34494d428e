// How strongly things are drawn that devices have reported, by age.

/** Things are drawn in full up to this age: devices at 1 Hz, and the way to the page, are not a failure. */
export const FRESH_MILLIS = 1500;
/** From this age on, things are drawn most faintly. */
const FADED_MILLIS = 6000;
const MIN_OPACITY = 0.2;
/** Differences that nobody sees are not drawn. */
const STEP = 0.1;

/** Opacity by age, milliseconds. An unknown age counts as old. */
export function freshness(ageMillis: number): number {
  if (!(ageMillis < FADED_MILLIS)) return MIN_OPACITY;
  const share = Math.max(0, (ageMillis - FRESH_MILLIS) / (FADED_MILLIS - FRESH_MILLIS));
  return Math.round((1 - share * (1 - MIN_OPACITY)) / STEP) * STEP;
}
