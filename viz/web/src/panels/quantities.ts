// Numbers as text, with the units of the terminal and of the report.

/** A count with separators. */
export function countText(n: number): string {
  return n.toLocaleString("en-US");
}

/** A size in decimal units. */
export function bytesText(bytes: number): string {
  if (bytes < 1e6) return `${(bytes / 1e3).toFixed(0)} kB`;
  if (bytes < 1e9) return `${(bytes / 1e6).toFixed(1)} MB`;
  return `${(bytes / 1e9).toFixed(2)} GB`;
}

/** The duration of a step. */
export function stepTimeText(millis: number | null): string {
  if (millis === null) return "–";
  if (millis >= 10_000) return `${(millis / 1000).toFixed(0)} s`;
  if (millis >= 1000) return `${(millis / 1000).toFixed(1)} s`;
  return `${millis >= 100 ? millis.toFixed(0) : millis.toPrecision(3)} ms`;
}

/** A latency, milliseconds. Long ones are in seconds. */
export function latencyText(millis: number): string {
  return millis < 10_000 ? `${Math.round(millis)} ms` : durationText(millis / 1000);
}

/** How long something has taken, to the second. */
export function timeText(seconds: number): string {
  if (seconds < 120) return `${Number(seconds.toFixed(seconds < 10 ? 1 : 0))} s`;
  const whole = Math.round(seconds);
  const minutes = Math.floor(whole / 60);
  const rest = whole - 60 * minutes;
  if (minutes < 60) return rest ? `${minutes} min ${rest} s` : `${minutes} min`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** About how long something lasts, such as "40 s", "4 min" or "2.5 h". */
export function durationText(secs: number): string {
  if (secs < 100) return `${secs.toFixed(secs < 10 ? 1 : 0)} s`;
  return secs < 6000 ? `${Math.round(secs / 60)} min` : `${(secs / 3600).toFixed(1)} h`;
}

/** Age of data that should be live. An infinite age means that the age is unknown. */
export function ageText(millis: number): string {
  return Number.isFinite(millis) ? `${durationText(millis / 1000)} old` : "not live";
}

/** A duration as on a stopwatch: minutes and seconds, and hours if there are any. */
export function stopwatchText(secs: number): string {
  const whole = Math.max(0, Math.floor(secs));
  const twoDigits = (value: number): string => String(value).padStart(2, "0");
  const minutes = Math.floor(whole / 60);
  const end = twoDigits(whole % 60);
  return minutes < 60 ? `${minutes}:${end}` : `${Math.floor(minutes / 60)}:${twoDigits(minutes % 60)}:${end}`;
}
