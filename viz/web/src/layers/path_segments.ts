// The path of the base as separate segments, so that it can have gaps.

/** Indices of the ends of all segments between consecutive points, except of those to points that start a line. */
export function pathSegments(nPoints: number, lineStarts: readonly number[]): number[] {
  const starts = new Set(lineStarts);
  const segments: number[] = [];
  for (let ix = 1; ix < nPoints; ix += 1) if (!starts.has(ix)) segments.push(ix - 1, ix);
  return segments;
}
