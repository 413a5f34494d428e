// ray_gradients: gradients with respect to rotation and translation of every ray, computed from the gradients of its
// sample positions.
//
// threads   one per ray
// reads     batch, rays, spans, v_points [n_samples]
// writes    v_rays [n_rays, 2] (with respect to rotation about the ray's origin; to translation)
// twin      nerf/reference/pose.rs
//
// Neglects the effect of rotation on the view direction of colors, which is small compared with the effect on
// positions.

#import folded
#import ray_batch

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> rays: array<Ray>;
@group(0) @binding(2) var<storage, read> spans: array<Span>;
@group(0) @binding(3) var<storage, read> v_points: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> v_rays: array<vec4f>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ray_ix = folded(wg, n_wgs) * 64u + lane;
    if ray_ix >= batch.n_rays { return; }
    let ray = rays[ray_ix];
    var v_origin = vec3f(0.0);
    var v_direction = vec3f(0.0);
    for (var ix = ray.first_sample; ix < ray.first_sample + ray.n_samples; ix++) {
        let v = v_points[ix].xyz;
        v_origin += v;
        v_direction += 0.5 * (spans[ix].begin + spans[ix].end) * v;
    }
    v_rays[2u * ray_ix] = vec4f(cross(ray.direction, v_direction), 0.0);
    v_rays[2u * ray_ix + 1u] = vec4f(v_origin, 0.0);
}
