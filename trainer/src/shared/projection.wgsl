// projection: projects a splat to the image. Returns intermediate values that the gradient needs.
//
// twin      splat/reference/project.rs
// source    Zwicker et al. 2001 (EWA volume splatting); Kerbl et al. 2023, section 4. As in gsplat, x/z and y/z are
//           clamped in the Jacobian, and the low-pass is 0.3 pixels squared (at full size). The motion of the camera
//           during the readout, up to the splat's row, moves the point and its Jacobian by the camera's twist.

const MIN_ALPHA = 0.00392156862745098; // 1 / 255
const MAX_ALPHA = 0.999;
const MIN_TRANSMITTANCE = 1e-4;

struct Projection {
    visible: bool,
    point: vec3f,             // in camera, after the shutter motion
    tau: f32,                 // fraction of the readout, -0.5 to 0.5
    mean_px: vec2f,
    covariance: vec3f,        // xx, xy, yy with the low-pass, pixels squared
    determinant: f32,
    compensation: f32,        // opacity factor: area of the ellipse without the low-pass filter / area with it
    jacobian_x: vec3f,        // rows of the pinhole Jacobian
    jacobian_y: vec3f,
    unclamped: vec2f,         // 1 where x/z, y/z is inside the clamp
    rotation: mat3x3f,        // of the splat, columns are its axes in world
    axes: mat3x3f,            // camera_from_splat axes times scale: covariance_in_camera = axes * transpose(axes)
    scale: vec3f,
    camera_rotation: mat3x3f, // camera_from_world, including the rotation during the shutter
}

fn rotation_of(q_wxyz: vec4f) -> mat3x3f {
    let q = q_wxyz / max(length(q_wxyz), 1e-12);
    let w = q.x; let x = q.y; let y = q.z; let z = q.w;
    return mat3x3f(
        vec3f(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3f(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3f(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
}

// The matrix of the cross product `axis x`.
fn cross_matrix(axis: vec3f) -> mat3x3f {
    return mat3x3f(vec3f(0.0, axis.z, -axis.y), vec3f(-axis.z, 0.0, axis.x), vec3f(axis.y, -axis.x, 0.0));
}

fn project_splat(view: View, mean: vec3f, rotation_wxyz: vec4f, log_scale: vec3f) -> Projection {
    var out: Projection;
    let still = camera_from_world(view, mean);
    let row_px = view.focal_px.y * still.y / still.z + view.principal_px.y;
    let apparent_motion = view.shutter_linear.xyz + cross(view.shutter_angular.xyz, still);
    out.tau = select(clamp(row_px / f32(view.size_px.y), 0.0, 1.0) - 0.5, 0.0, still.z < view.shutter_linear.w);
    out.point = still - out.tau * apparent_motion;
    let z = out.point.z;
    out.visible = z >= view.shutter_linear.w && z <= view.shutter_angular.w;
    let inverse_z = 1.0 / max(z, 1e-6);
    out.mean_px = view.focal_px * out.point.xy * inverse_z + view.principal_px;

    let tan_half = 0.5 * vec2f(view.size_px) / view.focal_px;
    let highest = (vec2f(view.size_px) - view.principal_px) / view.focal_px + 0.3 * tan_half;
    let lowest = -(view.principal_px / view.focal_px + 0.3 * tan_half);
    let ratio = out.point.xy * inverse_z;
    let clamped = clamp(ratio, lowest, highest);
    out.unclamped = select(vec2f(0.0), vec2f(1.0), ratio == clamped);
    out.jacobian_x = vec3f(view.focal_px.x * inverse_z, 0.0, -view.focal_px.x * clamped.x * inverse_z);
    out.jacobian_y = vec3f(0.0, view.focal_px.y * inverse_z, -view.focal_px.y * clamped.y * inverse_z);

    let camera = transpose(mat3x3f(view.camera_row_0.xyz, view.camera_row_1.xyz, view.camera_row_2.xyz));
    out.camera_rotation = camera - out.tau * (cross_matrix(view.shutter_angular.xyz) * camera);
    out.rotation = rotation_of(rotation_wxyz);
    out.scale = exp(log_scale);
    let rotated = out.camera_rotation * out.rotation;
    out.axes = mat3x3f(rotated[0] * out.scale.x, rotated[1] * out.scale.y, rotated[2] * out.scale.z);
    let row_x = out.jacobian_x * out.axes;
    let row_y = out.jacobian_y * out.axes;
    let low_pass_px2 = view.center_in_world.w;
    out.covariance = vec3f(dot(row_x, row_x) + low_pass_px2, dot(row_x, row_y), dot(row_y, row_y) + low_pass_px2);
    // Without the low-pass, the determinant is a squared cross product. Computing it this way avoids cancellation.
    let area = cross(row_x, row_y);
    out.determinant = dot(area, area) + low_pass_px2 * (out.covariance.x + out.covariance.z - low_pass_px2);
    out.compensation = sqrt(dot(area, area) / out.determinant);
    return out;
}

fn sigmoid(x: f32) -> f32 {
    return 1.0 / (1.0 + exp(-x));
}
