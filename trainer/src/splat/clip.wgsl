// clip: hides the splats outside the crop box or in erased space, and finds the boxes that cut the other splats. Runs
// after `project`, and only if there is a crop box or anything is erased.
//
// Boxes cut splats pixel by pixel, because a long splat with its center inside a box can reach far beyond it. Erased
// cells hide a whole splat if they contain its center. This is correct because the cells were also determined from the
// centers of splats.
//
// threads   one per splat
// reads     view, model, means, rotations, shapes, projected_splats, erased
// writes    depth_keys (all ones if hidden), clips [n_splats] (not if hidden)
// twin      splat/reference/clip.rs

#import view
#import model
#import projection
#import splat_clip
#import space
#import erased

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<storage, read> means: array<vec4f>;       // in world, meters; w unused
@group(0) @binding(3) var<storage, read> rotations: array<vec4f>;   // w x y z, any length
@group(0) @binding(4) var<storage, read> shapes: array<vec4f>;      // log_scale.xyz, opacity_logit
@group(0) @binding(5) var<storage, read> projected_splats: array<ProjectedSplat>;
@group(0) @binding(6) var<storage, read> erased: array<vec4u>;
@group(0) @binding(7) var<storage, read_write> depth_keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> clips: array<Clip>;

const INVISIBLE = 0xffffffffu; // Same value as in project.wgsl.

// Relations of a splat to a box.
const OUTSIDE = 0u;
const CUT = 1u;
const INSIDE = 2u;

// Relation of the drawn part of a splat to a box. The drawn part extends by `half_extent` from the center of the splat
// along the axes of the box.
fn relation(center: vec3f, half_extent: vec3f, low: vec3f, high: vec3f) -> u32 {
    if any(center + half_extent < low) || any(center - half_extent > high) { return OUTSIDE; }
    if all(center - half_extent >= low) && all(center + half_extent <= high) { return INSIDE; }
    return CUT;
}

// Half extent of an ellipsoid along the axes of a box. The columns of `axes` are the half axes of the ellipsoid in
// world.
fn half_extent(row_0: vec4f, row_1: vec4f, row_2: vec4f, axes: mat3x3f) -> vec3f {
    return vec3f(length(row_0.xyz * axes), length(row_1.xyz * axes), length(row_2.xyz * axes));
}

fn relation_to_crop(mean: vec3f, axes: mat3x3f) -> u32 {
    if view.crop_min.w == 0.0 { return INSIDE; }
    let point = vec4f(mean, 1.0);
    let center = vec3f(dot(view.crop_row_0, point), dot(view.crop_row_1, point), dot(view.crop_row_2, point));
    let extent = half_extent(view.crop_row_0, view.crop_row_1, view.crop_row_2, axes);
    return relation(center, extent, view.crop_min.xyz, view.crop_max.xyz);
}

fn relation_to_edit(group: u32, mean: vec3f, axes: mat3x3f) -> u32 {
    if !is_box(group) { return select(OUTSIDE, INSIDE, cells_erase(group, mean)); }
    let extent = half_extent(
        bitcast<vec4f>(erased[group]), bitcast<vec4f>(erased[group + 1u]), bitcast<vec4f>(erased[group + 2u]), axes);
    return relation(point_in_edit(group, mean), extent, min_of_box(group), max_of_box(group));
}

// Sets the boxes that cut the splat. Returns whether the splat is hidden.
fn find_boxes(clip: ptr<function, Clip>, mean: vec3f, axes: mat3x3f) -> bool {
    let in_crop = relation_to_crop(mean, axes);
    if in_crop == OUTSIDE { return true; }
    (*clip).is_cropped = select(0u, 1u, in_crop == CUT);
    let n_edits = erased[0].x;
    for (var ix = 0u; ix < n_edits; ix++) {
        let in_edit = relation_to_edit(group_of_edit(ix), mean, axes);
        if in_edit == INSIDE { return true; }
        let bit = select(0u, 1u << (ix % 32u), in_edit == CUT);
        if ix < 32u { (*clip).boxes_low |= bit; } else { (*clip).boxes_high |= bit; }
    }
    return false;
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let splat_ix = folded(wg, n_wgs) * 256u + lane;
    if splat_ix >= model.n_splats || depth_keys[splat_ix] == INVISIBLE { return; }
    let mean = means[splat_ix].xyz;
    let projection = project_splat(view, mean, rotations[splat_ix], shapes[splat_ix].xyz);
    let rotation = projection.rotation;
    let scale = projection.scale;
    let axes = mat3x3f(rotation[0] * scale.x, rotation[1] * scale.y, rotation[2] * scale.z);
    let conic = projected_splats[splat_ix].conic;
    // The conditional mean given the pixel follows from the covariance of point and pixel times the inverse covariance
    // of the pixel. The covariance of the pixel includes the low-pass, so the point stays within the ellipsoid in which
    // the splat is drawn.
    let with_x = axes * (projection.jacobian_x * projection.axes);
    let with_y = axes * (projection.jacobian_y * projection.axes);
    var clip = Clip(mean, 0u, with_x * conic.x + with_y * conic.y, 0u, with_x * conic.y + with_y * conic.z, 0u);
    if find_boxes(&clip, mean, axes * sqrt(max(conic.w, 0.0))) {
        depth_keys[splat_ix] = INVISIBLE;
    } else {
        clips[splat_ix] = clip;
    }
}
