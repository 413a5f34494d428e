// Draws a splat as a quad. It is the twin of trainer/src/shared/projection.wgsl and coverage.wgsl
// and, with CLIPS, of trainer/src/splat/clip.wgsl and shared/clipping.wgsl. Local pictures must
// equal the pictures of the server. trainer/src/splat/chunks/codec.rs encodes the splats.

import { TINT } from "./observation_layer";
import { CLIP_FRAGMENT, CLIP_VERTEX } from "./splat_clip";
import { UNIT_SPLATS } from "./splat_sorter";

/** Texels per row of the textures with one texel per splat. */
export const ROW_SPLATS = 2048;
/** Units of splats in such a row. */
export const ROW_UNITS = ROW_SPLATS / UNIT_SPLATS;
/** Texels per unit in `units`. */
export const UNIT_TEXELS = 3;

export const SPLAT_VERTEX = /* glsl */ `
  precision highp float;
  precision highp int;
  precision highp sampler2D;
  precision highp usampler2D;
  uniform usampler2D base;      // mean, scale, rotation, opacity and color
  uniform usampler2D harmonics; // color coefficients of degree 1 and 2, six of 5 bits in each word
  uniform sampler2D units;      // for each unit of splats: min, log of the factor; step, lowest log scale; see below
  uniform mat4 cameraFromModel; // x right, y down, z forward
  uniform mat4 worldFromModel;
  uniform vec3 eyeInModel;
  uniform vec2 sizePx;
  uniform vec2 focalPx;
  uniform vec2 principalPx;
  uniform vec2 depthRange;
  uniform float maxReach;  // square of the radius at which splats are cut off, standard deviations
  uniform vec2 ndcOfDepth; // depth buffer: y / depth - x, or 0 if it is not used
  in vec3 position;
  in uint slot;
  out vec2 deviations;
  flat out vec4 color;
  flat out float reach;
  flat out float depth;
#ifdef CLIPS
${CLIP_VERTEX}
#endif
${TINT}

  const float MIN_ALPHA = 1.0 / 255.0;
  const float LOW_PASS_PX2 = 0.3;

  mat3 rotationOf(uint word) {
    int largest = int(word >> 30u);
    vec3 others = (vec3(uvec3(word >> 20u, word >> 10u, word) & 1023u) / 1023.0 * 2.0 - 1.0) * 0.7071067811865476;
    float rest = sqrt(max(0.0, 1.0 - dot(others, others)));
    vec4 q = largest == 0 ? vec4(rest, others)
      : largest == 1 ? vec4(others.x, rest, others.yz)
      : largest == 2 ? vec4(others.xy, rest, others.z)
      : vec4(others, rest);
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
      1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
      2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
      2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
  }

  vec3 coefficient(uvec4 words, int basis) {
    uint word = words[basis / 2] >> (basis % 2 == 0 ? 0u : 15u);
    return vec3(uvec3(word, word >> 5u, word >> 10u) & 31u) - 16.0;
  }

  vec3 viewDependent(uvec4 words, vec2 steps, vec3 d) {
    vec3 first = 0.4886025119029199
      * (-d.y * coefficient(words, 0) + d.z * coefficient(words, 1) - d.x * coefficient(words, 2));
    vec3 second = 1.0925484305920792 * (d.x * d.y * coefficient(words, 3) - d.y * d.z * coefficient(words, 4))
      + 0.31539156525252005 * (2.0 * d.z * d.z - d.x * d.x - d.y * d.y) * coefficient(words, 5)
      - 1.0925484305920792 * d.x * d.z * coefficient(words, 6)
      + 0.5462742152960396 * (d.x * d.x - d.y * d.y) * coefficient(words, 7);
    return steps.x * first + steps.y * second;
  }

  void main() {
    gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // Outside: not drawn.
    ivec2 texel = ivec2(int(slot) % ${ROW_SPLATS}, int(slot) / ${ROW_SPLATS});
    uint unit = slot / ${UNIT_SPLATS}u;
    ivec2 unitTexel = ivec2(int(unit % ${ROW_UNITS}u) * ${UNIT_TEXELS}, int(unit / ${ROW_UNITS}u));
    vec4 low = texelFetch(units, unitTexel, 0);
    vec4 grid = texelFetch(units, unitTexel + ivec2(1, 0), 0);
    vec4 steps = texelFetch(units, unitTexel + ivec2(2, 0), 0); // steps of log scale and of coefficients of degree 1 and 2; w: 0 unused, 1 in use, 2 in use and antialiased
    if (steps.w == 0.0) return;
    uvec4 words = texelFetch(base, texel, 0);

    uvec3 counts = uvec3(words.x & 8191u, (words.x >> 13u) & 8191u, (words.x >> 26u) | ((words.y & 127u) << 6u));
    vec3 mean = low.xyz + vec3(counts) * grid.xyz;
    vec3 inWorld = (worldFromModel * vec4(mean, 1.0)).xyz;
    vec3 point = (cameraFromModel * vec4(mean, 1.0)).xyz;
    if (point.z < depthRange.x || point.z > depthRange.y) return;
    float alpha = float(words.w & 255u) / 255.0;
    if (alpha < MIN_ALPHA) return;

    vec3 logScale = grid.w + vec3(uvec3(words.y >> 7u, words.y >> 15u, words.y >> 23u) & 255u) * steps.x + low.w;
    mat3 rotation = rotationOf(words.z);
    mat3 axes = mat3(cameraFromModel) * rotation;
    vec3 scale = exp(logScale);
    axes[0] *= scale.x;
    axes[1] *= scale.y;
    axes[2] *= scale.z;
    vec2 margin = 0.15 * sizePx / focalPx;
    vec2 ratio = point.xy / point.z;
    vec2 clamped = clamp(ratio, -principalPx / focalPx - margin, (sizePx - principalPx) / focalPx + margin);
    vec3 rowX = vec3(focalPx.x, 0.0, -focalPx.x * clamped.x) / point.z * axes;
    vec3 rowY = vec3(0.0, focalPx.y, -focalPx.y * clamped.y) / point.z * axes;
    float xx = dot(rowX, rowX) + LOW_PASS_PX2;
    float xy = dot(rowX, rowY);
    float yy = dot(rowY, rowY) + LOW_PASS_PX2;

    if (steps.w == 2.0) {
      // The low-pass filter enlarges the splat. The opacity is reduced so that the product of
      // opacity and area stays the same (Yu et al. 2024, equation 12).
      vec3 area = cross(rowX, rowY);
      alpha *= sqrt(dot(area, area) / (xx * yy - xy * xy));
      if (alpha < MIN_ALPHA) return;
    }

    // The quad lies along the axes of the ellipse. Its corners are in standard deviations.
    reach = min(2.0 * log(255.0 * alpha), maxReach);
    float middle = 0.5 * (xx + yy);
    float spread = length(vec2(0.5 * (xx - yy), xy));
    vec2 along = abs(xy) > 1e-6 * middle ? normalize(vec2(xy, middle + spread - xx))
      : xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0);
    vec2 lengths = sqrt(max(vec2(middle + spread, middle - spread), vec2(0.0)));
    deviations = position.xy * sqrt(reach);
    vec2 offsetPx = along * lengths.x * deviations.x + vec2(-along.y, along.x) * lengths.y * deviations.y;
#ifdef CLIPS
    mat3 worldAxes = mat3(worldFromModel) * rotation;
    worldAxes[0] *= scale.x;
    worldAxes[1] *= scale.y;
    worldAxes[2] *= scale.z;
    if (isHidden(inWorld, worldAxes * sqrt(reach))) return;
    vec2 conicPx = vec2(yy * offsetPx.x - xy * offsetPx.y, xx * offsetPx.y - xy * offsetPx.x) / (xx * yy - xy * xy);
    clipPoint = inWorld + worldAxes * rowX * conicPx.x + worldAxes * rowY * conicPx.y;
#endif
    vec2 px = focalPx * ratio + principalPx + offsetPx;
    gl_Position = vec4(2.0 * px.x / sizePx.x - 1.0, 1.0 - 2.0 * px.y / sizePx.y, ndcOfDepth.y / point.z - ndcOfDepth.x, 1.0);

    depth = point.z;
    vec3 rgb = vec3(uvec3(words.w >> 8u, words.w >> 16u, words.w >> 24u) & 255u) / 127.5 - 0.5;
    if (steps.y > 0.0 || steps.z > 0.0) {
      rgb += viewDependent(texelFetch(harmonics, texel, 0), steps.yz, normalize(mean - eyeInModel));
    }
    color = vec4(tinted(max(rgb, 0.0), inWorld), alpha);
  }`;

export const SPLAT_FRAGMENT = /* glsl */ `
  precision highp float;
  in vec2 deviations;
  flat in vec4 color;
  flat in float reach;
  flat in float depth;
  out vec4 blended;
#ifdef CLIPS
${CLIP_FRAGMENT}
#endif
  void main() {
    float square = dot(deviations, deviations);
    if (square > reach) discard;
#ifdef CLIPS
    if (!isShown()) discard;
#endif
    float alpha = min(0.999, color.a * exp(-0.5 * square));
#ifdef WRITES_DEPTH
    blended = vec4(depth * alpha, alpha, 0.0, alpha);
#else
    blended = vec4(color.rgb * alpha, alpha);
#endif
  }`;
