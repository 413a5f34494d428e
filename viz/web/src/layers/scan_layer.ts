// The latest scan of each range scanner, colored by height, and the path of the base.

import * as THREE from "three";
import { type Occlusion, ON_SURFACE } from "./occlusion";
import type { RangeScanHeader } from "../connection/protocol";

const SIZE_PX = 3;
const PATH_COLOR = 0xe3b341;
/** Hues of the lowest and of the highest point. */
const HUES = [0.66, 0.05] as const;

export class ScanLayer {
  readonly root = new THREE.Group();
  private readonly scans = new THREE.Group();
  private readonly material: THREE.PointsMaterial;
  private readonly byScanner = new Map<string, THREE.Points>();
  private readonly path: THREE.Line;
  private hasPath = false;

  constructor(occlusion: Occlusion) {
    this.material = occlusion.apply(
      new THREE.PointsMaterial({ size: SIZE_PX, sizeAttenuation: false, vertexColors: true }),
      ON_SURFACE,
    );
    const line = new THREE.LineBasicMaterial({ color: PATH_COLOR });
    this.path = new THREE.Line(new THREE.BufferGeometry(), occlusion.apply(line, ON_SURFACE));
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
    const points = new THREE.Points(geometry, this.material);
    points.frustumCulled = false;
    points.position.fromArray(header.origin_m);
    points.scale.setScalar(header.meters_per_count);
    this.byScanner.set(header.scanner, points);
    this.scans.add(points);
  }

  /** Shows the path of the base, in world. */
  setPath(points: [number, number, number][]): void {
    this.hasPath = points.length > 1;
    this.path.geometry.dispose();
    this.path.geometry = new THREE.BufferGeometry().setFromPoints(points.map((point) => new THREE.Vector3(...point)));
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
    const points = this.byScanner.get(scanner);
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
