// The latest scan of each range scanner, colored by height, and the path of the base.

import * as THREE from "three";
import { freshness } from "./freshness";
import { type Occlusion, ON_SURFACE } from "./occlusion";
import { pathSegments } from "./path_segments";
import type { RangeScanHeader } from "../connection/protocol";

const SIZE_PX = 3;
const PATH_COLOR = 0xe3b341;
/** Hues of the lowest and of the highest point. */
const HUES = [0.66, 0.05] as const;

/** The latest scan of a scanner. */
interface Scan {
  points: THREE.Points<THREE.BufferGeometry, THREE.PointsMaterial>;
  /** Start of the revolution, on the server's clock; null if the server does not report it. */
  capturedMillis: number | null;
}

export class ScanLayer {
  readonly root = new THREE.Group();
  private readonly scans = new THREE.Group();
  /** A material for each scanner, because scans of different ages have different opacities. */
  private readonly materials = new Map<string, THREE.PointsMaterial>();
  private readonly byScanner = new Map<string, Scan>();
  private readonly path: THREE.LineSegments;
  private hasPath = false;

  constructor(private readonly occlusion: Occlusion) {
    const line = new THREE.LineBasicMaterial({ color: PATH_COLOR });
    this.path = new THREE.LineSegments(new THREE.BufferGeometry(), occlusion.apply(line, ON_SURFACE));
    this.path.frustumCulled = false;
    this.root.add(this.scans, this.path);
  }

  /** Whether scans are drawn. */
  set enabled(enabled: boolean) {
    this.scans.visible = enabled;
    if (!enabled) this.clear();
  }

  /** Whether there is a scan or a path to draw. */
  get isVisible(): boolean {
    return (this.scans.visible && this.byScanner.size > 0) || this.hasPath;
  }

  /** Shows a scan in place of the scanner's previous one. */
  show(header: RangeScanHeader, payload: Uint8Array<ArrayBuffer>): void {
    this.remove(header.scanner);
    // A copy has the alignment that typed arrays need.
    const counts = new Int16Array(payload.slice(0, 6 * header.n_points).buffer);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Int16BufferAttribute(counts, 3));
    geometry.setAttribute("color", new THREE.Float32BufferAttribute(heightColors(counts), 3));
    const points = new THREE.Points(geometry, this.material(header.scanner));
    points.frustumCulled = false;
    points.position.fromArray(header.origin_m);
    points.scale.setScalar(header.meters_per_count);
    this.byScanner.set(header.scanner, { points, capturedMillis: header.captured_millis ?? null });
    this.scans.add(points);
  }

  /** Draws older scans more faintly. Returns whether this is a change. */
  showAges(ageMillis: (capturedMillis: number) => number): boolean {
    let isChange = false;
    for (const { points, capturedMillis } of this.byScanner.values()) {
      const opacity = capturedMillis === null ? 1 : freshness(ageMillis(capturedMillis));
      isChange ||= points.material.opacity !== opacity;
      points.material.opacity = opacity;
    }
    return isChange;
  }

  /** The oldest of the drawn scans; null without scans of known age. */
  oldest(ageMillis: (capturedMillis: number) => number): { scanner: string; ageMillis: number } | null {
    let oldest: { scanner: string; ageMillis: number } | null = null;
    for (const [scanner, { capturedMillis }] of this.byScanner) {
      if (capturedMillis === null) continue;
      const age = ageMillis(capturedMillis);
      if (!oldest || age > oldest.ageMillis) oldest = { scanner, ageMillis: age };
    }
    return this.scans.visible ? oldest : null;
  }

  private material(scanner: string): THREE.PointsMaterial {
    const known = this.materials.get(scanner);
    if (known) return known;
    const options = { size: SIZE_PX, sizeAttenuation: false, vertexColors: true, transparent: true };
    const material = this.occlusion.apply(new THREE.PointsMaterial(options), ON_SURFACE);
    this.materials.set(scanner, material);
    return material;
  }

  /** Shows the path of the base, in world. `lineStarts`: indices of the points at which a new line begins. */
  setPath(points: [number, number, number][], lineStarts: number[] = []): void {
    this.hasPath = points.length > 1;
    this.path.geometry.dispose();
    this.path.geometry = new THREE.BufferGeometry().setFromPoints(points.map((point) => new THREE.Vector3(...point)));
    this.path.geometry.setIndex(pathSegments(points.length, lineStarts));
  }

  /** A box around the path, in world; empty without a path. */
  get pathBox(): THREE.Box3 {
    return this.hasPath ? new THREE.Box3().setFromObject(this.path) : new THREE.Box3();
  }

  /** Removes all scans. */
  clear(): void {
    for (const scanner of [...this.byScanner.keys()]) this.remove(scanner);
  }

  private remove(scanner: string): void {
    const points = this.byScanner.get(scanner)?.points;
    if (!points) return;
    points.geometry.dispose();
    this.scans.remove(points);
    this.byScanner.delete(scanner);
  }
}

function heightColors(counts: Int16Array): Float32Array {
  const heights = counts.filter((_, ix) => ix % 3 === 2);
  const lowest = heights.reduce((min, value) => Math.min(min, value), Infinity);
  const highest = heights.reduce((max, value) => Math.max(max, value), -Infinity);
  const colors = new Float32Array(counts.length);
  const color = new THREE.Color();
  heights.forEach((height, ix) => {
    const share = highest > lowest ? (height - lowest) / (highest - lowest) : 0;
    color.setHSL(HUES[0] + share * (HUES[1] - HUES[0]), 0.8, 0.6).toArray(colors, 3 * ix);
  });
  return colors;
}
