// Tints the model by when, or how precisely, each part of it was observed.

import * as THREE from "three";
import { element } from "../panels/element";
import { child } from "../panels/html";
import type { ObservationsHeader } from "../connection/protocol";
import type { ServerClock } from "../connection/server_clock";
import { inflated } from "./zlib";

/** What the tint shows. */
export type Quantity = "age" | "uncertainty";

/** The color scale, as text and colors from the best to the worst value. */
export interface Legend {
  title: string;
  labels: readonly string[];
  colors: readonly string[];
}

/** Colors of plasma (matplotlib), from the best to the worst value. */
const COLORS = ["#f0f921", "#fdb42f", "#ed7953", "#cc4778", "#9c179e", "#5b02a3"] as const;
/** The best and the worst value of the color scale: seconds, meters. */
const RANGES: Record<Quantity, [number, number]> = { age: [1, 1000], uncertainty: [1e-5, 1e-1] };
/** Labels of the scale, at equal distances. */
const LABELS: Record<Quantity, string[]> = {
  age: ["up to 1 s", "10 s", "100 s", "1000 s or more"],
  uncertainty: ["up to 0.01 mm", "0.1 mm", "1 mm", "1 cm", "10 cm or more"],
};
const TITLES: Record<Quantity, string> = {
  age: "Time since each place was last in a keyframe",
  uncertainty: "Standard deviation of the position, from the keyframes",
};
/** Maps with a smaller fraction of the keyframes are incomplete. */
const MIN_MAPPED_FRAC = 0.9;
/** Opacity of the colors of an incomplete map, whose ages and uncertainties are too large. */
const FAINT_OPACITY = 0.35;
const SCALE = COLORS.map(
  (color) => new THREE.Vector3(...[1, 3, 5].map((ix) => parseInt(color.slice(ix, ix + 2), 16) / 255)),
);
const MIX = SCALE.slice(1)
  .map((color, ix) => `  color = mix(color, ${glsl(color)}, clamp(worst * ${SCALE.length - 1}.0 - ${ix}.0, 0.0, 1.0));`)
  .join("\n");

/** The function `tinted`, for shaders in GLSL ES 3.0. */
export const TINT = /* glsl */ `
  uniform mediump sampler3D observations; // codes of age and standard deviation
  uniform int observedQuantity;           // 0: no tint, 1: age, 2: standard deviation
  uniform vec3 observationsMin;
  uniform vec3 observationsSize;
  uniform vec3 observationCodes;          // numbers of code 1, and logarithm of the ratio of two codes
  uniform vec2 observationRange;          // logarithms of the best and the worst number
  uniform float observationAge;           // seconds since the newest view
  uniform float observationOpacity;       // of the tint

  vec3 tinted(vec3 rgb, vec3 pointInWorld) {
    if (observedQuantity == 0) return rgb;
    float gray = dot(rgb, vec3(0.299, 0.587, 0.114));
    vec3 at = (pointInWorld - observationsMin) / observationsSize;
    bool isInside = all(greaterThanEqual(at, vec3(0.0))) && all(lessThan(at, vec3(1.0)));
    vec2 codes = isInside ? round(textureLod(observations, at, 0.0).rg * 255.0) : vec2(0.0);
    float code = observedQuantity == 1 ? codes.r : codes.g;
    if (code == 0.0) return mix(rgb, vec3(0.3 * gray), observationOpacity); // not observed
    float number = (observedQuantity == 1 ? observationCodes.x : observationCodes.y)
      * exp(observationCodes.z * (code - 1.0));
    if (observedQuantity == 1) number += observationAge;
    float worst = code == 255.0 ? 1.0
      : clamp((log(number) - observationRange.x) / (observationRange.y - observationRange.x), 0.0, 1.0);
    vec3 color = ${glsl(SCALE[0]!)};
${MIX}
    return mix(rgb, color * (0.5 + 0.6 * gray), observationOpacity);
  }`;

export class ObservationLayer {
  /** Uniforms of `tinted`, shared by all materials. */
  readonly uniforms = {
    observations: { value: texture(new Uint8Array(2), [1, 1, 1]) },
    observedQuantity: { value: 0 },
    observationsMin: { value: new THREE.Vector3() },
    observationsSize: { value: new THREE.Vector3(1, 1, 1) },
    observationCodes: { value: new THREE.Vector3() },
    observationRange: { value: new THREE.Vector2() },
    observationAge: { value: 0 },
    observationOpacity: { value: 1 },
  };
  /** Called with each new map: its header, and the codes of ages, then of standard deviations. */
  onMap: ((header: ObservationsHeader, codes: Uint8Array) => void) | null = null;
  private quantity: Quantity | null = null;
  private newestMillis: number | null = null;
  private hasMap = false;
  private nMapped = 0;
  private nAll = 0;
  /** Counts the maps, so that an older one does not replace a newer one. */
  private nReceived = 0;

  constructor(
    private readonly clock: () => ServerClock,
    private readonly changed: () => void,
  ) {
    element("legend-scale").style.background = `linear-gradient(to right, ${COLORS.join(", ")})`;
    window.setInterval(() => {
      if (this.quantity === "age" && this.newestMillis !== null) this.update();
    }, 1000);
  }

  /** Sets the number of keyframes of the run. */
  set nKeyframes(nAll: number) {
    if (nAll === this.nAll) return;
    this.nAll = nAll;
    if (this.quantity) this.update();
  }

  /** The legend of the tint; null without a tint. */
  get legend(): Legend | null {
    const title = element("legend-title").textContent;
    return this.quantity && { title, labels: LABELS[this.quantity], colors: COLORS };
  }

  /** Sets what the tint shows; null: no tint. */
  show(quantity: Quantity | null): void {
    this.quantity = quantity;
    this.update();
  }

  /** Adopts a new map. */
  async receive(header: ObservationsHeader, payload: Uint8Array<ArrayBuffer>): Promise<void> {
    const number = ++this.nReceived;
    const nCells = header.n_cells[0] * header.n_cells[1] * header.n_cells[2];
    const codes = await inflated(payload, 2 * nCells);
    if (codes.length !== 2 * nCells) throw new Error(`a map has ${codes.length} bytes, not ${2 * nCells}`);
    if (number !== this.nReceived) return;
    this.onMap?.(header, codes);
    const interleaved = new Uint8Array(2 * nCells);
    for (let ix = 0; ix < nCells; ix++) {
      interleaved[2 * ix] = codes[ix]!;
      interleaved[2 * ix + 1] = codes[nCells + ix]!;
    }
    const { uniforms } = this;
    uniforms.observations.value.dispose();
    uniforms.observations.value = texture(interleaved, header.n_cells);
    uniforms.observationsMin.value.fromArray(header.min_m);
    uniforms.observationsSize.value.fromArray(header.n_cells).multiplyScalar(header.cell_m);
    uniforms.observationCodes.value.set(header.min_age_secs, header.min_sigma_m, header.log_step);
    this.newestMillis = header.newest_millis;
    this.hasMap = true;
    this.nMapped = header.n_keyframes;
    this.update();
  }

  /** Drops the map, for example because a new server has another clock. */
  clear(): void {
    this.nReceived += 1;
    this.hasMap = false;
    this.update();
  }

  /** While the depth of some keyframes is still being rendered, ages and uncertainties are too large. */
  private get isComplete(): boolean {
    return this.nMapped >= MIN_MAPPED_FRAC * this.nAll;
  }

  private progress(): string {
    return this.isComplete ? "" : `. Faint, because only ${this.nMapped} of ${this.nAll} keyframes are processed so far`;
  }

  private update(): void {
    const { quantity, uniforms } = this;
    element("legend").hidden = quantity === null;
    uniforms.observedQuantity.value = !this.hasMap || quantity === null ? 0 : quantity === "age" ? 1 : 2;
    if (quantity !== null) {
      uniforms.observationRange.value.fromArray(RANGES[quantity].map(Math.log));
      const age = this.newestMillis === null ? null : this.clock().ageOf(this.newestMillis)();
      uniforms.observationAge.value = Math.max(0, (age ?? 0) / 1000);
      uniforms.observationOpacity.value = this.isComplete ? 1 : FAINT_OPACITY;
      const isSaved = quantity === "age" && this.newestMillis === null;
      element("legend-title").textContent = this.hasMap
        ? TITLES[quantity] + (isSaved ? ", relative to the newest keyframe" : "") + this.progress()
        : this.nAll > 0
          ? `Computing: 0 of ${this.nAll} keyframes are processed`
          : "This map is computed from keyframes, but there are none";
      element("legend-labels").replaceChildren(...LABELS[quantity].map((label) => child("span", label)));
    }
    this.changed();
  }
}

function texture(codes: Uint8Array<ArrayBuffer>, [width, height, depth]: [number, number, number]): THREE.Data3DTexture {
  const made = new THREE.Data3DTexture(codes, width, height, depth);
  made.format = THREE.RGFormat;
  made.unpackAlignment = 1;
  made.needsUpdate = true;
  return made;
}

function glsl({ x, y, z }: THREE.Vector3): string {
  return `vec3(${[x, y, z].map((part) => part.toFixed(4)).join(", ")})`;
}
