// update: sum each splat's gradients over its intersections, propagate them to its parameters, and take one Adam
// step.
//
// threads   256 per block of 256 splats
// reads     view, model, rule, projected_splats, tile_counts, slot_begins, gradients, status
// writes    means, rotations, shapes, sh_dc, sh_rest, their moments, error_sums; with GRADIENTS_ONLY, the gradients in
//           place of the values, for tests
// twin      splat/reference/project.rs, backward; optim/reference.rs
// source    Kerbl et al. 2023, appendix A; Kingma and Ba 2015; noise of Kheradmand et al. 2024 (3DGS-MCMC), section 4.1;
//           one second moment for many values as in Adam-mini (Zhang et al. 2024)
//
// The higher SH coefficients of a splat share one second moment and have no first moment. The sum of the squared basis
// functions of a degree is the same in every direction, so the mean square of the gradients is |v_color|^2 / (12 pi). A
// first moment is unnecessary because the learning rate is small: the parameters themselves average over many steps.

#import view
#import model
#import projection
#import sh
#import status
#import gradient
#import random

struct Rule {
    mean_rate_m: f32,             // initial rate
    log_scale_rate: f32,
    rotation_rate: f32,
    opacity_rate: f32,
    sh_dc_rate: f32,
    sh_rest_rate: f32,
    noise: f32,                   // scale of the noise on the means of nearly transparent splats, relative to their learning rate
    final_mean_rate_frac: f32,    // fraction of the means' rate that remains at the end
    betas: vec2f,                 // of Adam
    epsilon: f32,                 // of Adam
    n_planned_steps: f32,
    opacity_cost: f32,            // per splat
    scale_cost: f32,              // per splat and meter
    log_scale_range: vec2f,
    seed: u32,
    update_all: u32,              // 1: also update splats that are not visible in this view
    schedule_start: f32,          // step at which the planned steps begin
    noise_center: f32,            // opacity at which the noise has half its maximum
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<uniform> rule: Rule;
@group(0) @binding(3) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(4) var<storage, read> slot_begins: array<u32>;
@group(0) @binding(5) var<storage, read> gradients: array<vec4f>; // [n_slots, 3], parts of `Gradient`
@group(0) @binding(6) var<storage, read_write> means: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> rotations: array<vec4f>;
@group(0) @binding(8) var<storage, read_write> shapes: array<vec4f>;
@group(0) @binding(9) var<storage, read_write> sh_dc: array<f32>;
@group(0) @binding(10) var<storage, read_write> sh_rest: array<f32>;
@group(0) @binding(11) var<storage, read_write> moments: array<vec4f>;         // planes: first and second of means, rotations, shapes
@group(0) @binding(12) var<storage, read_write> sh_dc_moments: array<vec2f>;   // first and second
@group(0) @binding(13) var<storage, read_write> sh_rest_moments: array<f32>;     // second, shared
@group(0) @binding(14) var<storage, read_write> status: array<atomic<u32>>;
@group(0) @binding(15) var<storage, read_write> error_sums: array<f32>;        // since the last change of the splat count
@group(0) @binding(16) var<storage, read> projected_splats: array<ProjectedSplat>;

override GRADIENTS_ONLY: bool = false;
const PI = 3.14159265358979;
var<private> correction: vec2f;   // 1 / (1 - beta^t)

fn adam4(plane: u32, splat_ix: u32, gradient: vec4f) -> vec4f {
    let at = plane * model.capacity + splat_ix;
    let first = mix(gradient, moments[at], rule.betas.x);
    let second = mix(gradient * gradient, moments[at + model.capacity], rule.betas.y);
    moments[at] = first;
    moments[at + model.capacity] = second;
    return first * correction.x / (sqrt(second * correction.y) + rule.epsilon);
}

fn adam1(moment: ptr<function, vec2f>, gradient: f32) -> f32 {
    *moment = mix(vec2f(gradient, gradient * gradient), *moment, rule.betas);
    return (*moment).x * correction.x / (sqrt((*moment).y * correction.y) + rule.epsilon);
}

fn is_finite(x: vec4f) -> bool {
    return all((bitcast<vec4u>(x) & vec4u(0x7f800000u)) != vec4u(0x7f800000u));
}

struct ShSums {
    splat_ix: u32,
    v_color: vec3f,
    rest_step: vec3f,       // per unit of the basis function
    v_direction: vec3f,
}

fn add_sh_term(sums: ptr<function, ShSums>, k: u32, basis: f32, basis_gradient: vec3f) {
    let at = 3u * k * model.capacity + (*sums).splat_ix;
    let rest = vec3f(sh_rest[at], sh_rest[at + model.capacity], sh_rest[at + 2u * model.capacity]);
    (*sums).v_direction += basis_gradient * dot((*sums).v_color, rest);
    var updated = rest - basis * (*sums).rest_step;
    if GRADIENTS_ONLY { updated = basis * (*sums).v_color; }
    sh_rest[at] = updated.x;
    sh_rest[at + model.capacity] = updated.y;
    sh_rest[at + 2u * model.capacity] = updated.z;
}

// Contribution of one splat to the gradient with respect to the camera.
struct CameraGradient {
    rotation: vec3f,
    translation: vec3f,
    focal: vec2f,
    principal: vec2f,
}

#import camera_sums

// Splats with more intersections are summed by 32 lanes.
const MAX_SLOTS_PER_LANE = 16u;
const N_TEAMS = 8u;                           // of 32 lanes; 30 of them read 10 slots at once, one gradient part per lane
const TEAM_ROWS = 10u;
var<workgroup> wg_n_large: atomic<u32>;
var<workgroup> wg_n_large_read: u32;
var<workgroup> wg_large: array<u32, 256>;     // large splats of the block
var<workgroup> wg_parts: array<vec4f, 256>;   // [N_TEAMS, 32]

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = folded(wg, n_wgs);
    let splat_ix = block * 256u + lane;
    let exists = splat_ix < model.n_splats && atomicLoad(&status[FAILED]) == 0u;
    var n_touched = 0u;
    if exists { n_touched = tile_counts[splat_ix]; }
    let sum = gradient_of(lane, splat_ix, n_touched);
    var camera: CameraGradient;
    if exists { camera = update_splat(splat_ix, n_touched, sum); }
    add_up_camera(lane, block, camera);
}

// Sums the gradients of a splat's intersections in a fixed order. Every lane must call it.
fn gradient_of(lane: u32, splat_ix: u32, n_touched: u32) -> Gradient {
    var sum: Gradient;
    if lane == 0u { atomicStore(&wg_n_large, 0u); }
    workgroupBarrier(); // The number is zero.
    var large_ix = 0xffffffffu;
    if n_touched > MAX_SLOTS_PER_LANE {
        large_ix = atomicAdd(&wg_n_large, 1u); // The order of large splats does not affect their sums.
        wg_large[large_ix] = splat_ix;
    }
    workgroupBarrier(); // All large splats are listed.
    if lane == 0u { wg_n_large_read = atomicLoad(&wg_n_large); }
    let n_large = workgroupUniformLoad(&wg_n_large_read);
    // This comes after the barriers, so that subgroups do not wait for each other.
    if n_touched > 0u && n_touched <= MAX_SLOTS_PER_LANE {
        let begin = slot_begins[splat_ix];
        for (var slot = begin; slot < begin + n_touched; slot++) {
            sum.position += gradients[3u * slot];
            sum.conic += gradients[3u * slot + 1u];
            sum.color += gradients[3u * slot + 2u];
        }
    }
    for (var first = 0u; first < n_large; first += N_TEAMS) {
        let large = first + lane / 32u;
        var part = vec4f(0.0);
        if large < n_large && lane % 32u < 3u * TEAM_ROWS {
            let begin = slot_begins[wg_large[large]];
            let n_rows = tile_counts[wg_large[large]];
            for (var row = lane % 32u / 3u; row < n_rows; row += TEAM_ROWS) {
                part += gradients[3u * (begin + row) + lane % 32u % 3u];
            }
        }
        wg_parts[lane] = part;
        workgroupBarrier(); // The teams have summed their rows.
        if large_ix - first < N_TEAMS {
            let at = (large_ix - first) * 32u;
            for (var row = 0u; row < TEAM_ROWS; row++) {
                sum.position += wg_parts[at + 3u * row];
                sum.conic += wg_parts[at + 3u * row + 1u];
                sum.color += wg_parts[at + 3u * row + 2u];
            }
        }
        workgroupBarrier(); // The sums are read.
    }
    return sum;
}

fn update_splat(splat_ix: u32, n_touched: u32, sum: Gradient) -> CameraGradient {
    var camera: CameraGradient;
    if n_touched == 0u && rule.update_all == 0u && !GRADIENTS_ONLY { return camera; }

    let mean = means[splat_ix].xyz;
    let rotation = rotations[splat_ix];
    let shape = shapes[splat_ix];
    let p = project_splat(view, mean, rotation, shape.xyz);
    let opacity = sigmoid(shape.w);
    var v_mean = vec3f(0.0);
    var v_log_scale = vec3f(0.0);
    var v_rotation = vec4f(0.0);
    let drop_frac = bitcast<f32>(atomicLoad(&status[DROP_FRAC])); // `project` divides the opacity by one minus this.
    let v_opacity_logit = sum.position.w * opacity * (1.0 - opacity) / (1.0 - drop_frac);
    if n_touched != 0u {
        // The gradient is propagated from the conic to the covariance. The derivative of the inverse is -M G M.
        let a = p.covariance.z / p.determinant;
        let b = -p.covariance.y / p.determinant;
        let c = p.covariance.x / p.determinant;
        let ga = sum.conic.x; let gb = 0.5 * sum.conic.y; let gc = sum.conic.z;
        let hxx = -(a * (a * ga + b * gb) + b * (a * gb + b * gc));
        let hxy = -(b * (a * ga + b * gb) + c * (a * gb + b * gc));
        let hyy = -(b * (b * ga + c * gb) + c * (b * gb + c * gc));
        let row_x = p.jacobian_x * p.axes;
        let row_y = p.jacobian_y * p.axes;
        let v_row_x = 2.0 * (hxx * row_x + hxy * row_y);
        let v_row_y = 2.0 * (hxy * row_x + hyy * row_y);
        let v_jacobian_x = p.axes * v_row_x;
        let v_jacobian_y = p.axes * v_row_y;
        let v_axis_0 = p.jacobian_x * v_row_x.x + p.jacobian_y * v_row_y.x;
        let v_axis_1 = p.jacobian_x * v_row_x.y + p.jacobian_y * v_row_y.y;
        let v_axis_2 = p.jacobian_x * v_row_x.z + p.jacobian_y * v_row_y.z;
        v_log_scale = vec3f(dot(v_axis_0, p.axes[0]), dot(v_axis_1, p.axes[1]), dot(v_axis_2, p.axes[2]));
        let back = transpose(p.camera_rotation);
        let v = mat3x3f(back * v_axis_0 * p.scale.x, back * v_axis_1 * p.scale.y, back * v_axis_2 * p.scale.z);

        // The gradient is propagated from the rotation matrix, as v[column][row], to the quaternion.
        let norm = max(length(rotation), 1e-12);
        let q = rotation / norm;
        let v_unit = 2.0 * vec4f(
            q.y * (v[1][2] - v[2][1]) + q.z * (v[2][0] - v[0][2]) + q.w * (v[0][1] - v[1][0]),
            -2.0 * q.y * (v[1][1] + v[2][2]) + q.z * (v[0][1] + v[1][0]) + q.w * (v[0][2] + v[2][0]) + q.x * (v[1][2] - v[2][1]),
            q.y * (v[0][1] + v[1][0]) - 2.0 * q.z * (v[0][0] + v[2][2]) + q.w * (v[1][2] + v[2][1]) + q.x * (v[2][0] - v[0][2]),
            q.y * (v[0][2] + v[2][0]) + q.z * (v[1][2] + v[2][1]) - 2.0 * q.w * (v[0][0] + v[1][1]) + q.x * (v[0][1] - v[1][0]),
        );
        v_rotation = (v_unit - q * dot(q, v_unit)) / norm;

        // The gradient is propagated from the image plane to the camera and to the world.
        let z = p.point.z;
        let f = view.focal_px;
        let ratio = -vec2f(p.jacobian_x.z, p.jacobian_y.z) * z / f; // clamped x/z, y/z
        var v_point = vec3f(sum.position.xy * f / z, sum.position.z - dot(sum.position.xy * f, p.point.xy) / (z * z));
        v_point.x -= p.unclamped.x * v_jacobian_x.z * f.x / (z * z);
        v_point.y -= p.unclamped.y * v_jacobian_y.z * f.y / (z * z);
        v_point.z += -v_jacobian_x.x * f.x / (z * z) - v_jacobian_y.y * f.y / (z * z)
            + v_jacobian_x.z * f.x * ratio.x * (1.0 + p.unclamped.x) / (z * z)
            + v_jacobian_y.z * f.y * ratio.y * (1.0 + p.unclamped.y) / (z * z);
        let v_mid_exposure = v_point + p.tau * cross(view.shutter_angular.xyz, v_point);
        let point_mid_exposure = camera_from_world(view, mean);
        camera.translation = v_mid_exposure;
        camera.rotation = cross(point_mid_exposure, v_mid_exposure);
        let splat_axes = transpose(mat3x3f(view.camera_row_0.xyz, view.camera_row_1.xyz, view.camera_row_2.xyz)) * p.rotation;
        let spin = p.tau * view.shutter_angular.xyz;
        camera.rotation += p.scale.x * cross(splat_axes[0], v_axis_0 + cross(spin, v_axis_0));
        camera.rotation += p.scale.y * cross(splat_axes[1], v_axis_1 + cross(spin, v_axis_1));
        camera.rotation += p.scale.z * cross(splat_axes[2], v_axis_2 + cross(spin, v_axis_2));
        camera.principal = sum.position.xy;
        camera.focal = sum.position.xy * p.point.xy / z + vec2f(dot(v_jacobian_x, p.jacobian_x), dot(v_jacobian_y, p.jacobian_y)) / f;
        v_mean = view.camera_row_0.xyz * v_mid_exposure.x + view.camera_row_1.xyz * v_mid_exposure.y + view.camera_row_2.xyz * v_mid_exposure.z;
    }

    let v_color = select(vec3f(0.0), sum.color.rgb, projected_splats[splat_ix].color.rgb > vec3f(0.0)); // Drawn colors are clamped at 0.
    if !GRADIENTS_ONLY && (!is_finite(vec4f(v_mean, v_opacity_logit)) || !is_finite(v_rotation) || !is_finite(vec4f(v_log_scale, sum.conic.w)) || !is_finite(vec4f(v_color, 0.0))) {
        atomicAdd(&status[N_NON_FINITE], 1u);
        return CameraGradient();
    }
    let step = f32(atomicLoad(&status[STEP]));
    correction = 1.0 / (1.0 - pow(rule.betas, vec2f(step + 1.0)));

    let mean_square = mix(dot(v_color, v_color) / (12.0 * PI), sh_rest_moments[splat_ix], rule.betas.y);
    let rest_step = rule.sh_rest_rate * v_color / (sqrt(mean_square * correction.y) + rule.epsilon);
    let to_splat = mean - view.center_in_world.xyz;
    let distance = max(length(to_splat), 1e-6);
    let direction = to_splat / distance;
    var sh = ShSums(splat_ix, v_color, rest_step, vec3f(0.0));
    each_sh(&sh, direction, model.sh_degree);
    let v_moved = (sh.v_direction - direction * dot(direction, sh.v_direction)) / distance;
    v_mean += v_moved;
    camera.translation += vec3f(dot(view.camera_row_0.xyz, v_moved), dot(view.camera_row_1.xyz, v_moved), dot(view.camera_row_2.xyz, v_moved));

    let capacity = model.capacity;
    if GRADIENTS_ONLY {
        means[splat_ix] = vec4f(v_mean, 0.0);
        rotations[splat_ix] = v_rotation;
        shapes[splat_ix] = vec4f(v_log_scale, v_opacity_logit);
        for (var channel = 0u; channel < 3u; channel++) { sh_dc[channel * capacity + splat_ix] = SH_0 * v_color[channel]; }
        error_sums[splat_ix] = sum.conic.w;
        return camera;
    }
    sh_rest_moments[splat_ix] = mean_square;
    let progress = clamp((step - rule.schedule_start) / max(rule.n_planned_steps, 1.0), 0.0, 1.0);
    let mean_rate = rule.mean_rate_m * pow(rule.final_mean_rate_frac, progress);
    // The costs double over the planned steps, because models start to overfit single images late in training.
    let cost_gradient = (1.0 + progress) * vec4f(rule.scale_cost * p.scale, rule.opacity_cost * opacity * (1.0 - opacity));
    let mean_step = adam4(0u, splat_ix, vec4f(v_mean, 0.0));
    let rotation_step = adam4(2u, splat_ix, v_rotation);
    let shape_step = adam4(4u, splat_ix, vec4f(v_log_scale, v_opacity_logit) + cost_gradient);

    // Noise moves nearly transparent splats to positions where they may be useful.
    let noise_weight = 1.0 / (1.0 + exp(100.0 * (opacity - rule.noise_center)));
    let normal = normal3(vec3u(splat_ix, atomicLoad(&status[STEP]), rule.seed));
    let stretched = p.rotation * (p.scale * p.scale * (transpose(p.rotation) * normal));
    let jitter = rule.noise * mean_rate * noise_weight * stretched;

    means[splat_ix] = vec4f(mean - mean_rate * mean_step.xyz + jitter, 0.0);
    let rotated = rotation - rule.rotation_rate * rotation_step;
    rotations[splat_ix] = rotated / max(length(rotated), 1e-12);
    let updated_shape = shape - vec4f(vec3f(rule.log_scale_rate), rule.opacity_rate) * shape_step;
    shapes[splat_ix] = vec4f(clamp(updated_shape.xyz, vec3f(rule.log_scale_range.x), vec3f(rule.log_scale_range.y)), clamp(updated_shape.w, -12.0, 12.0));
    for (var channel = 0u; channel < 3u; channel++) {
        let at = channel * capacity + splat_ix;
        var moment = sh_dc_moments[at];
        sh_dc[at] -= rule.sh_dc_rate * adam1(&moment, SH_0 * v_color[channel]);
        sh_dc_moments[at] = moment;
    }
    error_sums[splat_ix] += sum.conic.w;
    return camera;
}
