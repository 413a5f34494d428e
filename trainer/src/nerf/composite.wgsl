// composite: color of every ray, its error, and the gradients with respect to its samples.
//
// threads   one per ray
// reads     batch, loss, rays, spans, log_density [n_samples], colors [n_samples] (before the sigmoid)
// writes    ray_colors [n_rays] (rgb without background, transmittance), ray_errors [n_rays] (squared color error,
//           rendered distance), v_log_density [n_samples], v_colors [n_samples]
// twin      nerf/reference/ray.rs
// source    Max 1995; line of sight of Rematas et al. 2022, equations 9 to 12, with a band instead of a bell curve;
//           distortion of Barron et al. 2022, equation 15, in one pass as in Sun et al. 2022
//
// Gradients are with respect to the mean loss over the rays.

#import folded
#import ray_batch
#import ray_loss
#import density
#import sample

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> loss: RayLoss;
@group(0) @binding(2) var<storage, read> rays: array<Ray>;
@group(0) @binding(3) var<storage, read> spans: array<Span>;
@group(0) @binding(4) var<storage, read> log_density: array<f32>;
@group(0) @binding(5) var<storage, read> colors: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> ray_colors: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> ray_errors: array<vec2f>;
@group(0) @binding(8) var<storage, read_write> v_log_density: array<f32>;
@group(0) @binding(9) var<storage, read_write> v_colors: array<vec4f>;

// Maps distances from near to infinity to 0 to 1.
fn normalized_distance(t: f32) -> f32 {
    return 1.0 - loss.near / max(t, loss.near);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    let ray = rays[ray_ix];
    let end = ray.first_sample + ray.n_samples;
    let band = vec2f(ray.target_distance, loss.band + loss.band_frac * ray.target_distance);
    let line_of_sight = select(0.0, 2.0 * loss.line_of_sight / f32(batch.n_rays), ray.target_distance > 0.0);
    var weight_near_reading = 0.0;     // sum of the weights close to the depth reading
    var weight_sq_elsewhere = 0.0;    // sum of the squared weights of the other samples
    var rgb = vec3f(0.0);
    var distance = 0.0;
    var transmittance = 1.0;
    var total = vec2f(0.0); // sums of weights, and of weights times normalized distance
    for (var ix = ray.first_sample; ix < end; ix++) {
        let sample = sample_at(ix);
        let weight = transmittance * (1.0 - sample.transmitted);
        rgb += weight * sample.rgb;
        distance += weight * 0.5 * (sample.begin + sample.end);
        if is_near_reading(sample, band) { weight_near_reading += weight; } else { weight_sq_elsewhere += weight * weight; }
        total += weight * vec2f(1.0, 0.5 * (normalized_distance(sample.begin) + normalized_distance(sample.end)));
        transmittance *= sample.transmitted;
    }
    ray_colors[ray_ix] = vec4f(rgb, transmittance);
    let background = loss.background_srgb.rgb;
    let residual = rgb + transmittance * background - unpack4x8unorm(ray.target_rgb).rgb;
    ray_errors[ray_ix] = vec2f(dot(residual, residual) / 3.0, distance);

    let per_ray = 1.0 / f32(batch.n_rays);
    let is_unmasked = ray.target_rgb >= 0x01000000u;
    let v_rgb = select(vec3f(0.0), 2.0 / 3.0 * per_ray * residual, is_unmasked);
    var v_transmittance = dot(v_rgb, background);
    var v_distance = 0.0;
    let distance_residual = distance - (1.0 - transmittance) * ray.target_distance;
    if ray.target_distance > 0.0 && abs(distance_residual) < loss.distance_clip {
        v_distance = loss.distance_weight * per_ray * sign(distance_residual);
        v_transmittance += v_distance * ray.target_distance;
    }
    // The part behind a sample is the total minus the part of the sample and the part in front of it.
    var behind = dot(v_rgb, rgb) + v_distance * distance + line_of_sight * (weight_sq_elsewhere - (1.0 - weight_near_reading) * weight_near_reading);
    let distortion_weight = loss.distortion * per_ray;
    var before = vec2f(0.0);
    // A separate pass adds the distortion gradients of the weights to `behind`.
    var transmittance_before = 1.0;
    for (var ix = ray.first_sample; ix < end && distortion_weight > 0.0; ix++) {
        let sample = sample_at(ix);
        let weight = transmittance_before * (1.0 - sample.transmitted);
        behind += weight * distortion_gradient(sample, weight, before, total) * distortion_weight;
        before += weight * vec2f(1.0, 0.5 * (normalized_distance(sample.begin) + normalized_distance(sample.end)));
        transmittance_before *= sample.transmitted;
    }
    before = vec2f(0.0);
    transmittance_before = 1.0;
    for (var ix = ray.first_sample; ix < end; ix++) {
        let sample = sample_at(ix);
        let weight = transmittance_before * (1.0 - sample.transmitted);
        let middle = 0.5 * (sample.begin + sample.end);
        var v_weight = dot(v_rgb, sample.rgb) + v_distance * middle;
        v_weight += line_of_sight * select(weight, weight_near_reading - 1.0, is_near_reading(sample, band));
        if distortion_weight > 0.0 { v_weight += distortion_weight * distortion_gradient(sample, weight, before, total); }
        before += weight * vec2f(1.0, 0.5 * (normalized_distance(sample.begin) + normalized_distance(sample.end)));
        transmittance_before *= sample.transmitted;
        behind -= weight * v_weight;
        let v_density = (sample.end - sample.begin) * (transmittance_before * v_weight - behind - transmittance * v_transmittance);
        v_log_density[ix] = select(v_density * sample.density, 0.0, sample.is_clamped);
        v_colors[ix] = vec4f(weight * v_rgb * sample.rgb * (1.0 - sample.rgb), 0.0);
    }
}

// Whether a sample is near the depth reading. `band` is the distance and tolerance of the reading.
fn is_near_reading(sample: Sample, band: vec2f) -> bool {
    return abs(0.5 * (sample.begin + sample.end) - band.x) <= band.y;
}

fn distortion_gradient(sample: Sample, weight: f32, before: vec2f, total: vec2f) -> f32 {
    let normalized_ends = vec2f(normalized_distance(sample.begin), normalized_distance(sample.end));
    let middle = 0.5 * (normalized_ends.x + normalized_ends.y);
    let after = total - before - weight * vec2f(1.0, middle);
    let separation = middle * before.x - before.y + after.y - middle * after.x;
    return 2.0 * separation + 2.0 / 3.0 * weight * (normalized_ends.y - normalized_ends.x);
}
