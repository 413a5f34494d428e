// Cuts splats at the crop box and at erased boxes, pixel by pixel; see trainer/src/shared/splat_clip.wgsl.

import * as THREE from "three";
import { boxFromWorld, type Crop } from "../view/oriented_box";

/** Texels of a box: three rows of the transform from world to its frame, and its corners. */
const BOX_TEXELS = 5;
/** Maximum number of erased boxes, and thus of bits. Servers have the same limit. */
const MAX_BOXES = 64;

const BOXES = /* glsl */ `
  uniform highp sampler2D boxes; // one row of texels per box: first the crop box, then the erased ones
  uniform bool isCropped;
  uniform int nErased;
  vec3 pointInBox(int box, vec4 homogeneous) {
    return vec3(
      dot(texelFetch(boxes, ivec2(0, box), 0), homogeneous),
      dot(texelFetch(boxes, ivec2(1, box), 0), homogeneous),
      dot(texelFetch(boxes, ivec2(2, box), 0), homogeneous));
  }
  vec3 minOfBox(int box) { return texelFetch(boxes, ivec2(3, box), 0).xyz; }
  vec3 maxOfBox(int box) { return texelFetch(boxes, ivec2(4, box), 0).xyz; }`;

/**
 * Defines `isHidden`, and declares `clipPoint`, where the density along the ray of a pixel is largest, in world. `cuts`
 * are the boxes that cut the splat: 1 for the crop box, and bits of the erased boxes in two words.
 */
export const CLIP_VERTEX = /* glsl */ `${BOXES}
  out vec3 clipPoint;
  flat out uvec3 cuts;
  const int OUTSIDE = 0;
  const int CUT = 1;
  const int INSIDE = 2;
  // Relation of a splat to a box; the columns of halfAxes are the half axes of the ellipsoid in which it is drawn.
  int relation(int box, vec3 mean, mat3 halfAxes) {
    vec3 center = pointInBox(box, vec4(mean, 1.0));
    vec3 extent = vec3(
      length(texelFetch(boxes, ivec2(0, box), 0).xyz * halfAxes),
      length(texelFetch(boxes, ivec2(1, box), 0).xyz * halfAxes),
      length(texelFetch(boxes, ivec2(2, box), 0).xyz * halfAxes));
    vec3 low = minOfBox(box);
    vec3 high = maxOfBox(box);
    if (any(lessThan(center + extent, low)) || any(greaterThan(center - extent, high))) return OUTSIDE;
    bool isInside = all(greaterThanEqual(center - extent, low)) && all(lessThanEqual(center + extent, high));
    return isInside ? INSIDE : CUT;
  }
  // Sets the boxes that cut a splat. Returns whether nothing of it is drawn.
  bool isHidden(vec3 mean, mat3 halfAxes) {
    cuts = uvec3(0u);
    if (isCropped) {
      int inCrop = relation(0, mean, halfAxes);
      if (inCrop == OUTSIDE) return true;
      cuts.x = inCrop == CUT ? 1u : 0u;
    }
    for (int ix = 0; ix < nErased; ix++) {
      int inErased = relation(1 + ix, mean, halfAxes);
      if (inErased == INSIDE) return true;
      uint bit = inErased == CUT ? 1u << uint(ix & 31) : 0u;
      if (ix < 32) cuts.y |= bit;
      else cuts.z |= bit;
    }
    return false;
  }`;

/** Defines `isShown` for the pixel. */
export const CLIP_FRAGMENT = /* glsl */ `
  precision highp int;
${BOXES}
  in vec3 clipPoint;
  flat in uvec3 cuts;
  bool isInside(int box) {
    vec3 point = pointInBox(box, vec4(clipPoint, 1.0));
    return all(greaterThanEqual(point, minOfBox(box))) && all(lessThanEqual(point, maxOfBox(box)));
  }
  bool isShown() {
    if (cuts.x != 0u && !isInside(0)) return false;
    if ((cuts.y | cuts.z) == 0u) return true;
    for (int ix = 0; ix < nErased; ix++) {
      uint bits = ix < 32 ? cuts.y : cuts.z;
      if (((bits >> uint(ix & 31)) & 1u) != 0u && isInside(1 + ix)) return false;
    }
    return true;
  }`;

/** Takes the place of an absent crop box. */
const EMPTY: Crop = { min_m: [0, 0, 0], max_m: [0, 0, 0] };

/** The boxes as uniforms of the shaders. */
export class SplatClip {
  readonly uniforms = {
    boxes: { value: boxTexture([]) },
    isCropped: { value: false },
    nErased: { value: 0 },
  };
  private crop: Crop | undefined;
  private erased: Crop[] = [];

  /** Whether any box can cut a splat. Only then, materials need the define CLIPS. */
  get isUsed(): boolean {
    return this.crop !== undefined || this.erased.length > 0;
  }

  /** Sets the box to which splats are limited. */
  setCrop(crop: Crop | undefined): void {
    if (isSame(crop, this.crop)) return;
    this.crop = crop;
    this.uniforms.isCropped.value = crop !== undefined;
    this.upload();
  }

  /** Sets the boxes that are cut out of splats. Returns whether they have changed. */
  setErased(boxes: Crop[]): boolean {
    const erased = boxes.slice(0, MAX_BOXES);
    if (isSame(erased, this.erased)) return false;
    this.erased = erased;
    this.uniforms.nErased.value = erased.length;
    this.upload();
    return true;
  }

  private upload(): void {
    this.uniforms.boxes.value.dispose();
    this.uniforms.boxes.value = boxTexture([this.crop ?? EMPTY, ...this.erased]);
  }
}

function isSame(a: Crop | Crop[] | undefined, b: Crop | Crop[] | undefined): boolean {
  return JSON.stringify(a) === JSON.stringify(b);
}

function boxTexture(boxes: Crop[]): THREE.DataTexture {
  const height = Math.max(1, boxes.length);
  const data = new Float32Array(4 * BOX_TEXELS * height);
  data.set(boxes.flatMap(texelsOf));
  const texture = new THREE.DataTexture(data, BOX_TEXELS, height, THREE.RGBAFormat, THREE.FloatType);
  texture.needsUpdate = true;
  return texture;
}

function texelsOf(box: Crop): number[] {
  return [...boxFromWorld(box).flatMap((row) => row.toArray()), ...box.min_m, 0, ...box.max_m, 0];
}
