// apply_poses: corrects rays by the optimized poses of their images.
//
// threads   one per ray
// reads     batch, image_params [n_images, IMAGE_PARAM_STRIDE]
// writes    rays (origin, direction)
// twin      nerf/reference/pose.rs

#import folded
#import ray_batch
#import image_params

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> image_params: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> rays: array<Ray>;

// source: Rodrigues 1840; series where the angle is small
fn rotated(rotation: vec3f, v: vec3f) -> vec3f {
    let angle = length(rotation);
    let is_small = angle < 0.01;
    let along = select(sin(angle) / angle, 1.0 - angle * angle / 6.0, is_small);
    let across = select((1.0 - cos(angle)) / (angle * angle), 0.5 - angle * angle / 24.0, is_small);
    let first = cross(rotation, v);
    return v + along * first + across * cross(rotation, first);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    let first = rays[ray_ix].embedding * IMAGE_PARAM_STRIDE;
    let rotation = vec3f(image_params[first].x, image_params[first + 1u].x, image_params[first + 2u].x);
    let translation = vec3f(image_params[first + TRANSLATION].x, image_params[first + TRANSLATION + 1u].x, image_params[first + TRANSLATION + 2u].x);
    rays[ray_ix].origin += translation;
    rays[ray_ix].direction = rotated(rotation, rays[ray_ix].direction);
}
