// erase: makes the splats invisible whose means are in erased space. Runs after `project`, and only if anything is
// erased.
//
// threads   one per splat
// reads     model, means, erased
// writes    depth_keys (all ones if erased)

#import folded
#import model
#import space
#import erased

@group(0) @binding(0) var<uniform> model: Model;
@group(0) @binding(1) var<storage, read> means: array<vec4f>;       // in world, meters; w unused
@group(0) @binding(2) var<storage, read> erased: array<vec4u>;
@group(0) @binding(3) var<storage, read_write> depth_keys: array<u32>;

const INVISIBLE = 0xffffffffu; // Same value as in project.wgsl.

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let splat_ix = folded(wg, n_wgs) * 256u + lane;
    if splat_ix >= model.n_splats || depth_keys[splat_ix] == INVISIBLE { return; }
    if is_erased(means[splat_ix].xyz) { depth_keys[splat_ix] = INVISIBLE; }
}
