// Identifies robots by their names, and by a color and a letter that follow from the names.

import type { Identity } from "../connection/protocol";

/** The first name that is known: the rig's, the robot's, or the run's. */
export function nameOf(identity: Identity | undefined): string {
  return identity?.rig ?? identity?.robot ?? identity?.run ?? "";
}

/** All names besides that of `nameOf`. */
export function detailsOf(identity: Identity | undefined): string {
  if (!identity) return "";
  const name = nameOf(identity);
  const names = [identity.robot, identity.run].filter((other) => other && other !== name);
  return names.join(" · ");
}

/** The first letter or digit of a name, as a capital. */
export function letterOf(name: string): string {
  return (/[\p{L}\p{N}]/u.exec(name)?.[0] ?? "").toUpperCase();
}

/** Hue of a name, degrees. Similar names have different hues. */
export function hueOf(name: string): number {
  // FNV-1a (Fowler, Noll, Vo 1991) with 32 bits, and multiples of 24 degrees, so that hues are equal or distinct.
  let hash = 0x811c9dc5;
  for (const byte of new TextEncoder().encode(name)) hash = Math.imul(hash ^ byte, 0x01000193) >>> 0;
  return 24 * (((hash ^ (hash >>> 16)) >>> 0) % 15);
}

/** The color of a name. */
export function colorOf(name: string): string {
  return `hsl(${hueOf(name)} 55% 42%)`;
}

/** An icon with the letter and the color of a name, as the address of an SVG file. */
export function iconOf(name: string): string {
  const svg = `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><rect width="32" height="32" rx="7" fill="${colorOf(name)}"/><text x="16" y="23" font-family="sans-serif" font-size="20" font-weight="700" fill="#fff" text-anchor="middle">${letterOf(name)}</text></svg>`;
  return `data:image/svg+xml,${encodeURIComponent(svg)}`;
}
