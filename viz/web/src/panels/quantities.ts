// Numbers as text. Units are the ones of the terminal and of the report.

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
