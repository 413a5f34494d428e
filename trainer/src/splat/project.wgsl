// project: project every splat onto the image plane and compute its color.
//
// threads   one per splat
// reads     view, model, means, rotations, shapes, sh_dc, sh_rest, status (fraction of dropped splats)
// writes    projected_splats [n_splats], depth_keys [n_splats] (all ones if invisible), status (smallest and largest depth)
// twin      splat/reference/project.rs
// source    Zwicker et al. 2001 (EWA volume splatting); Kerbl et al. 2023, section 4; dropping of splats during training:
//           Park et al. 2025 (DropGaussian); correction of opacities: Yu et al. 2024 (Mip-Splatting), equation 12

#import view
#import model
#import projection
#import sh
#import status
#import random

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<storage, read> means: array<vec4f>;       // in world, meters; w unused
@group(0) @binding(3) var<storage, read> rotations: array<vec4f>;   // w x y z, any length
@group(0) @binding(4) var<storage, read> shapes: array<vec4f>;      // log_scale.xyz, opacity_logit
@group(0) @binding(5) var<storage, read> sh_dc: array<f32>;         // 3 planes of `capacity`
@group(0) @binding(6) var<storage, read> sh_rest: array<f32>;       // 3 planes per basis function
@group(0) @binding(7) var<storage, read_write> projected_splats: array<ProjectedSplat>;
@group(0) @binding(8) var<storage, read_write> depth_keys: array<u32>;

@group(0) @binding(9) var<storage, read_write> status: array<atomic<u32>>;

const INVISIBLE = 0xffffffffu;
var<workgroup> wg_depth_range: array<vec2u, 256>;

struct ShSums {
    splat_ix: u32,
    color: vec3f,
}

fn add_sh_term(sums: ptr<function, ShSums>, k: u32, basis: f32, basis_gradient: vec3f) {
    let at = 3u * k * model.capacity + (*sums).splat_ix;
    (*sums).color += basis * vec3f(sh_rest[at], sh_rest[at + model.capacity], sh_rest[at + 2u * model.capacity]);
}

// Whether this step leaves the splat out.
fn is_dropped(splat_ix: u32, drop_frac: f32) -> bool {
    if drop_frac == 0.0 { return false; }
    return uniform3(vec3u(splat_ix, atomicLoad(&status[STEP]), atomicLoad(&status[DROP_SEED]))).x < drop_frac;
}

// Projects and colors a splat. Returns its depth key.
fn project(splat_ix: u32) -> u32 {
    let mean = means[splat_ix].xyz;
    let shape = shapes[splat_ix];
    let projection = project_splat(view, mean, rotations[splat_ix], shape.xyz);
    // The remaining splats become more opaque, so that the picture keeps its mean opacity.
    let drop_frac = bitcast<f32>(atomicLoad(&status[DROP_FRAC]));
    var opacity = sigmoid(shape.w) / (1.0 - drop_frac);
    // The low-pass enlarges the splat. In a model with this flag, the product of opacity and area stays the same.
    if model.is_antialiased != 0u { opacity *= projection.compensation; }
    // These comparisons are false for NaN, so a splat with a NaN is invisible.
    let visible = projection.visible && opacity > MIN_ALPHA && projection.determinant > 0.0
        && abs(projection.mean_px.x) < 1e6 && abs(projection.mean_px.y) < 1e6 && projection.covariance.x + projection.covariance.z < 1e12;
    if !visible || is_dropped(splat_ix, drop_frac) { return INVISIBLE; }

    let conic = vec3f(projection.covariance.z, -projection.covariance.y, projection.covariance.x) / projection.determinant;
    let reach = 2.0 * log(255.0 * opacity);
    // Bounding box of the ellipse within which the splat is drawn, plus half a pixel.
    let half_px = sqrt(max(vec2f(reach) * projection.covariance.xz, vec2f(0.0))) + 0.5;
    let last = projection.mean_px + half_px;
    let first = projection.mean_px - half_px;
    if any(last < vec2f(0.0)) || any(first > vec2f(view.size_px)) { return INVISIBLE; }

    let constant = vec3f(sh_dc[splat_ix], sh_dc[model.capacity + splat_ix], sh_dc[2u * model.capacity + splat_ix]);
    var sums = ShSums(splat_ix, vec3f(0.5) + SH_0 * constant);
    each_sh(&sums, normalize(mean - view.center_in_world.xyz), model.sh_degree);
    let color = max(sums.color, vec3f(0.0));
    projected_splats[splat_ix] = ProjectedSplat(vec4f(projection.mean_px, projection.point.z, opacity), vec4f(conic, reach), vec4f(color, 0.0));
    return bitcast<u32>(projection.point.z); // Positive floats sort like their bit patterns.
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let splat_ix = folded(wg, n_wgs) * 256u + lane;
    var key = INVISIBLE;
    if splat_ix < model.n_splats {
        key = project(splat_ix);
        depth_keys[splat_ix] = key;
    }
    wg_depth_range[lane] = select(vec2u(key, ~key), vec2u(0u), key == INVISIBLE);
    workgroupBarrier(); // All keys are written.
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        if lane < stride { wg_depth_range[lane] = max(wg_depth_range[lane], wg_depth_range[lane + stride]); }
        workgroupBarrier(); // The lower half of the lanes now holds the maxima of both halves.
    }
    if lane == 0u {
        atomicMax(&status[FURTHEST], wg_depth_range[0].x);
        atomicMax(&status[NEAREST], wg_depth_range[0].y);
    }
}
