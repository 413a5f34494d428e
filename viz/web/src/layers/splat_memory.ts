// The splats of all chunks in textures. A chunk occupies whole units, which need not follow each other.

import * as THREE from "three";
import type { SplatChunkHeader } from "../connection/protocol";
import { ROW_SPLATS, ROW_UNITS, UNIT_TEXELS } from "./splat_shader";
import { UNIT_SPLATS } from "./splat_sorter";

const WORDS_PER_SPLAT = 4;
const UNIT_WORDS = WORDS_PER_SPLAT * UNIT_SPLATS;
const UNIT_FLOATS = 4 * UNIT_TEXELS;
const INITIAL_ROWS = 32;
const MEAN_MAX = 8191;
const MAX_SH_COUNT = 15;

export class SplatMemory {
  base = splatTexture(INITIAL_ROWS);
  harmonics = splatTexture(INITIAL_ROWS);
  units = unitTexture(INITIAL_ROWS);
  private nRows = INITIAL_ROWS;
  private nUnits = 0;
  private readonly unused: number[] = [];

  /** Uploads everything again, because the WebGL context has lost it. */
  uploadAgain(): void {
    for (const texture of [this.base, this.harmonics, this.units]) {
      texture.clearUpdateRanges();
      texture.userData.isUploaded = false;
      texture.needsUpdate = true;
    }
  }

  /** Frees the textures. */
  dispose(): void {
    for (const texture of [this.base, this.harmonics, this.units]) texture.dispose();
  }

  /** Number of splats for which there is memory. */
  get capacity(): number {
    return this.nRows * ROW_SPLATS;
  }

  /** Reserves units for this many splats. Reuses those of an older version as far as possible. */
  allocate(nSplats: number, old: number[]): number[] {
    const n = Math.ceil(nSplats / UNIT_SPLATS);
    const units = old.slice(0, n);
    while (units.length < n) units.push(this.unused.pop() ?? this.nUnits++);
    this.free(old.slice(n));
    this.reserve(this.nUnits);
    return units;
  }

  /** Releases units; their splats are no longer drawn. */
  free(units: number[]): void {
    for (const unit of units) {
      (this.units.image.data as Float32Array)[UNIT_FLOATS * unit + UNIT_FLOATS - 1] = 0;
      updateRange(this.units, UNIT_FLOATS * unit, UNIT_FLOATS);
      this.unused.push(unit);
    }
  }

  /** Stores the splats of a chunk; `words` has the splats, followed by their color coefficients. */
  write(units: number[], header: SplatChunkHeader, words: Uint32Array): void {
    const { n_splats: n, min_m, max_m, log_scale_range, scale_factor, sh_ranges } = header;
    const hasHarmonics = header.sh_degree > 0;
    const description = [
      ...min_m,
      Math.log(scale_factor),
      ...max_m.map((max, axis) => (max - min_m[axis]!) / MEAN_MAX),
      log_scale_range[0],
      (log_scale_range[1] - log_scale_range[0]) / 255,
      ...sh_ranges.map((range) => (hasHarmonics ? range / MAX_SH_COUNT : 0)),
      header.is_antialiased ? 2 : 1,
    ];
    units.forEach((unit, ix) => {
      const [begin, end] = [ix * UNIT_WORDS, Math.min((ix + 1) * UNIT_WORDS, WORDS_PER_SPLAT * n)];
      writeWords(this.base, unit, words.subarray(begin, end));
      if (hasHarmonics) {
        const offset = WORDS_PER_SPLAT * n;
        writeWords(this.harmonics, unit, words.subarray(offset + begin, offset + end));
      }
      (this.units.image.data as Float32Array).set(description, UNIT_FLOATS * unit);
      updateRange(this.units, UNIT_FLOATS * unit, UNIT_FLOATS);
    });
  }

  private reserve(nUnits: number): void {
    if (nUnits <= this.nRows * ROW_UNITS) return;
    this.nRows = Math.max(2 * this.nRows, Math.ceil(nUnits / ROW_UNITS));
    this.base = grown(this.base, splatTexture(this.nRows));
    this.harmonics = grown(this.harmonics, splatTexture(this.nRows));
    this.units = grown(this.units, unitTexture(this.nRows));
  }
}

function splatTexture(nRows: number): THREE.DataTexture {
  const data = new Uint32Array(WORDS_PER_SPLAT * ROW_SPLATS * nRows);
  const texture = new THREE.DataTexture(data, ROW_SPLATS, nRows, THREE.RGBAIntegerFormat, THREE.UnsignedIntType);
  texture.internalFormat = "RGBA32UI";
  return marked(texture);
}

function unitTexture(nRows: number): THREE.DataTexture {
  const data = new Float32Array(UNIT_FLOATS * ROW_UNITS * nRows);
  return marked(new THREE.DataTexture(data, ROW_UNITS * UNIT_TEXELS, nRows, THREE.RGBAFormat, THREE.FloatType));
}

function grown(from: THREE.DataTexture, to: THREE.DataTexture): THREE.DataTexture {
  (to.image.data as Uint32Array | Float32Array).set(from.image.data as Uint32Array | Float32Array);
  from.dispose();
  return to;
}

/** Stores the splats of a unit. The rest of it is transparent. */
function writeWords(texture: THREE.DataTexture, unit: number, words: Uint32Array): void {
  const [data, begin] = [texture.image.data as Uint32Array, UNIT_WORDS * unit];
  data.set(words, begin);
  data.fill(0, begin + words.length, begin + UNIT_WORDS);
  updateRange(texture, begin, UNIT_WORDS);
}

/** Maximum number of ranges to upload; beyond it, everything is uploaded. A hidden layer uploads nothing. */
const MAX_RANGES = 1000;

/** Uploads only this range, or everything if the texture is new. */
function updateRange(texture: THREE.DataTexture, start: number, count: number): void {
  if (texture.updateRanges.length >= MAX_RANGES) {
    texture.clearUpdateRanges();
    texture.userData.isUploaded = false;
  }
  if (texture.userData.isUploaded === true) texture.addUpdateRange(start, count);
  texture.needsUpdate = true;
}

/** Marks a texture for upload. */
function marked(texture: THREE.DataTexture): THREE.DataTexture {
  texture.onUpdate = () => (texture.userData.isUploaded = true);
  texture.needsUpdate = true;
  return texture;
}
