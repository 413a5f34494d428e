// How strongly things are drawn that devices have reported, by age.

/** Things are drawn in full up to this age. Data of devices at 1 Hz can be this old without a failure. */
export const FRESH_MILLIS = 1500;
/** From this age on, things are drawn most faintly. */
const FADED_MILLIS = 6000;
const MIN_OPACITY = 0.2;
/** Opacity changes in steps of this size, because smaller differences are not visible. */
const STEP = 0.1;

/** Opacity by age, milliseconds. An unknown age counts as old. */
export function freshness(ageMillis: number): number {
  if (!(ageMillis < FADED_MILLIS)) return MIN_OPACITY;
  const share = Math.max(0, (ageMillis - FRESH_MILLIS) / (FADED_MILLIS - FRESH_MILLIS));
  return Math.round((1 - share * (1 - MIN_OPACITY)) / STEP) * STEP;
}
