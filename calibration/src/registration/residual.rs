//! Photometric and depth residuals of a sample of one image in another image, and their Jacobians.
//!
//! A depth reading becomes a point in the world. The point's brightness in image `i` is compared
//! with its brightness in image `j`. Its distance along the z axis of `j`'s depth camera is
//! compared with the depth reading of `j`. The two residuals are from Kerl, Sturm and Cremers 2013.
//! The motion of both cameras is from Schoeps et al. 2019. The separate pose of the depth camera
//! and the rolling shutter are additions of fieldrig.

use super::prepared_image::{DepthSample, GrayImage, PreparedImage, depth_at, point};
use super::view::{CorrectedView, unit_twist};
use nalgebra::Vector3;

/// Resolutions that differ by at most this factor count as equal.
const HALF_OCTAVE: f64 = std::f64::consts::SQRT_2;

/// An image with its corrected view.
#[derive(Clone, Copy)]
pub(super) struct Side<'a> {
    pub(super) image: &'a PreparedImage,
    pub(super) view: &'a CorrectedView,
}

/// A point as observed in one of the two images.
#[derive(Clone, Copy, Debug)]
struct ObservedPoint {
    /// Position in the color camera frame at mid-exposure.
    still: Vector3<f64>,
    /// Position in the color camera frame when the row of the point is read.
    read: Vector3<f64>,
    /// Readout time of the row as a share of the total readout time.
    share: f64,
    pixel: [f64; 2],
    brightness: f64,
    gradient: [f64; 2],
}

/// A sample of image `i` projected into image `j`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Correspondence {
    i: ObservedPoint,
    j: ObservedPoint,
    /// Position of the sample in the depth camera of `i`. The next field is the position of the
    /// sample in the depth camera of `j`.
    point_in_depth_i: Vector3<f64>,
    in_depth: Vector3<f64>,
    depth_pixel: [f64; 2],
    reading_m: f64,
    reading_gradient: [f64; 2],
    depth_weight: f64,
}

/// Gain and offset that map the brightness of image `i` to the brightness of image `j`. They are
/// needed because the exposures of the two images differ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tone {
    pub(super) gain: f64,
    pub(super) offset: f64,
}

impl Correspondence {
    /// Projects a sample. Returns `None` if the sample is outside `j`, occluded, or at an edge or
    /// hole. Readings may differ by `occlusion_frac` of the depth.
    pub(super) fn new(
        i: Side<'_>,
        j: Side<'_>,
        sample: &DepthSample,
        level: usize,
        occlusion_frac: f64,
    ) -> Option<Self> {
        let point_in_depth_i =
            point(i.view.depth_focal_px, i.view.depth_principal_px, sample) * i.view.depth_factor;
        let in_i = i.view.color_from_depth.apply(&point_in_depth_i);
        let in_j = j
            .view
            .world_from_camera
            .apply_inverse(&i.view.world_from_camera.apply(&in_i));
        let in_depth = j.view.color_from_depth.apply_inverse(&in_j);
        if !(in_i.z > 0.0 && in_j.z > 0.0 && in_depth.z > 0.0) {
            return None;
        }
        let depth_pixel = j.view.depth_pixel(&in_depth);
        let reading = depth_at(j.image.keyframe.depth.as_ref()?, depth_pixel)?;
        let factor = j.view.depth_factor;
        let reading_m = factor * reading.value;
        let reading_gradient = reading.gradient.map(|gradient| factor * gradient);
        if (reading_m - in_depth.z).abs() > occlusion_frac * reading_m {
            return None;
        }
        // Slope of the surface at the reading, as the change of depth per meter across the axis.
        let tilt =
            [0, 1].map(|axis| reading_gradient[axis] * j.view.depth_focal_px[axis] / reading_m);
        let [level_i, level_j] = levels([i, j], [in_i.z, in_j.z], level);
        Some(Self {
            i: ObservedPoint::new(i.view, in_i, i.image.level(level_i))?,
            j: ObservedPoint::new(j.view, in_j, j.image.level(level_j))?,
            point_in_depth_i,
            in_depth,
            depth_pixel,
            reading_m,
            reading_gradient,
            // The weight projects the difference along z onto the normal. It also accounts for
            // depth noise, which grows with the square of the depth.
            depth_weight: 1.0
                / ((1.0 + tilt[0] * tilt[0] + tilt[1] * tilt[1]).sqrt() * reading_m * reading_m),
        })
    }

    /// Pixel in `j`.
    pub(super) fn pixel(&self) -> [f64; 2] {
        self.j.pixel
    }

    pub(super) fn brightness(&self) -> [f64; 2] {
        [self.i.brightness, self.j.brightness]
    }

    /// Photometric residual, on a scale of 0 to 255.
    pub(super) fn photo(&self, tone: Tone) -> f64 {
        self.j.brightness - tone.gain * self.i.brightness - tone.offset
    }

    /// Depth residual along the normal, normalized to a depth of 1 m, meters.
    pub(super) fn depth(&self) -> f64 {
        self.depth_weight * (self.reading_m - self.in_depth.z)
    }

    /// Jacobian of [`Correspondence::photo`] with respect to the parameters, followed by gain and
    /// offset.
    pub(super) fn photo_jacobian(
        &self,
        i: &ParamColumns<'_>,
        j: &ParamColumns<'_>,
        tone: Tone,
        row: &mut [f64],
    ) {
        row.fill(0.0);
        let read_j = row_held_gradient(j.view, &self.j, &gradient_by_point(j.view, &self.j, 1.0));
        let read_i = row_held_gradient(
            i.view,
            &self.i,
            &gradient_by_point(i.view, &self.i, -tone.gain),
        );
        let gradient_j = mid_exposure_gradient(j.view, &self.j, &read_j);
        let gradient_i = mid_exposure_gradient(i.view, &self.i, &read_i);
        // Gradient with respect to the point in the axes of camera i. The point is fixed in camera
        // i, so a motion of camera i carries the point along and changes only its position in j. A
        // motion of camera j moves the point in the opposite direction relative to j.
        let gradient_through_poses = i
            .view
            .world_from_camera
            .rotation
            .tr_mul(&(j.view.world_from_camera.rotation * gradient_j));
        add_motion(i, &self.i.still, &gradient_through_poses, 1.0, row);
        add_motion(j, &self.j.still, &gradient_j, -1.0, row);
        add_depth(i, self, &(gradient_through_poses + gradient_i), row);
        add_lens(i, &self.i, -tone.gain, row);
        add_lens(j, &self.j, 1.0, row);
        for (param_columns, observed, read) in [(i, &self.i, &read_i), (j, &self.j, &read_j)] {
            if let Some(readout) = param_columns.readout {
                row[readout] += observed.share
                    * read.dot(&param_columns.view.twist.apparent_velocity(&observed.still));
            }
        }
        let n = row.len();
        row[n - 2] = -self.i.brightness;
        row[n - 1] = -1.0;
    }

    /// Jacobian of [`Correspondence::depth`] with respect to the parameters. It is zero for gain
    /// and offset.
    pub(super) fn depth_jacobian(
        &self,
        i: &ParamColumns<'_>,
        j: &ParamColumns<'_>,
        row: &mut [f64],
    ) {
        row.fill(0.0);
        let weight = self.depth_weight;
        let [fx, fy] = j.view.depth_focal_px;
        let q = &self.in_depth;
        let [sx, sy] = self.reading_gradient;
        // There are two terms, because both the reading at the pixel and the depth of the point
        // change.
        let along_z = -(sx * fx * q.x + sy * fy * q.y) / (q.z * q.z) - 1.0;
        let in_depth = Vector3::new(sx * fx / q.z, sy * fy / q.z, along_z) * weight;
        let gradient_j = j.view.color_from_depth.rotation * in_depth;
        let gradient_through_poses = i
            .view
            .world_from_camera
            .rotation
            .tr_mul(&(j.view.world_from_camera.rotation * gradient_j));
        add_motion(i, &self.i.still, &gradient_through_poses, 1.0, row);
        add_motion(j, &self.j.still, &gradient_j, -1.0, row);
        add_depth(i, self, &gradient_through_poses, row);
        if let Some(pose) = j.depth_pose {
            add_twist(&mut row[pose..pose + 6], &self.j.still, &gradient_j, -1.0);
        }
        if let Some(scale) = j.depth_scale {
            row[scale] += weight * self.reading_m;
        }
        if let (Some(lens), true) = (j.lens, j.view.shares_lens) {
            // The lens moves the pixel at which the depth of `j` is read.
            for axis in 0..2 {
                let gradient = weight * self.reading_gradient[axis];
                row[lens + axis] +=
                    gradient * (self.depth_pixel[axis] - j.view.depth_principal_px[axis]);
                let raw_share = j.view.keyframe_focal_px[axis] / j.view.focal_px[axis];
                row[lens + 2 + axis] += gradient * j.view.depth_focal_px[axis] * raw_share;
            }
        }
    }
}

/// Pyramid levels at which both images have about the same resolution on the surface. Neither level
/// is finer than `level`. The two levels differ if one view is nearer, because a near view has
/// detail that a distant view lacks.
fn levels([i, j]: [Side<'_>; 2], [z_i, z_j]: [f64; 2], level: usize) -> [usize; 2] {
    let texel_m =
        |side: Side<'_>, z_m: f64| z_m * side.image.level(level).texel_px() / side.view.focal_px[0];
    let of_i = texel_m(i, z_i);
    let of_j = texel_m(j, z_j);
    let octaves = |share: f64| {
        (0..3)
            .take_while(|octave| share > HALF_OCTAVE * f64::from(1 << octave))
            .count()
    };
    [level + octaves(of_j / of_i), level + octaves(of_i / of_j)]
}

impl ObservedPoint {
    fn new(view: &CorrectedView, still: Vector3<f64>, gray: &GrayImage) -> Option<Self> {
        let (read, share) = view.at_readout(&still);
        let pixel = view.pixel(&read);
        let observed = gray.at(pixel)?;
        Some(Self {
            still,
            read,
            share,
            pixel,
            brightness: observed.value,
            gradient: observed.gradient,
        })
    }
}

/// Columns of the Jacobian of a pair that belong to the parameters of one view.
#[derive(Debug)]
pub(super) struct ParamColumns<'a> {
    view: &'a CorrectedView,
    columns: Vec<(usize, Vector3<f64>, Vector3<f64>)>,
    depth_pose: Option<usize>,
    lens: Option<usize>,
    depth_scale: Option<usize>,
    readout: Option<usize>,
}

impl<'a> ParamColumns<'a> {
    /// `column_of` maps a parameter's index to its column.
    pub(super) fn new(view: &'a CorrectedView, column_of: impl Fn(usize) -> usize) -> Self {
        Self {
            columns: view
                .columns
                .iter()
                .map(|(param, linear, angular)| (column_of(*param), *linear, *angular))
                .collect(),
            depth_pose: view.depth_pose.map(&column_of),
            lens: view.lens.map(&column_of),
            depth_scale: view.depth_scale.map(&column_of),
            readout: view.readout.map(&column_of),
            view,
        }
    }

    /// Columns for only the motion of the camera (meters, then radians), starting at `begin`.
    pub(super) fn free(view: &'a CorrectedView, begin: usize) -> Self {
        let columns = (0..6)
            .map(|part| {
                let twist = unit_twist(part);
                (begin + part, twist.linear_m_s, twist.angular_rad_s)
            })
            .collect();
        Self {
            columns,
            ..Self::still(view)
        }
    }

    /// No columns, for a fixed camera.
    pub(super) fn still(view: &'a CorrectedView) -> Self {
        Self {
            view,
            columns: Vec::new(),
            depth_pose: None,
            lens: None,
            depth_scale: None,
            readout: None,
        }
    }
}

/// Gradient of `factor` times the brightness with respect to the point at its readout time.
fn gradient_by_point(view: &CorrectedView, observed: &ObservedPoint, factor: f64) -> Vector3<f64> {
    let [sx, sy] =
        [0, 1].map(|axis| factor * observed.gradient[axis] * view.focal_px[axis] / observed.read.z);
    Vector3::new(
        sx,
        sy,
        -(sx * observed.read.x + sy * observed.read.y) / observed.read.z,
    )
}

/// Gradient with respect to a displacement of the point at its readout time. The gradient includes
/// the effect that a displacement also changes the row and thus the readout time.
fn row_held_gradient(
    view: &CorrectedView,
    observed: &ObservedPoint,
    gradient: &Vector3<f64>,
) -> Vector3<f64> {
    // The row is differentiated implicitly: position = displaced point - drift * share(row), and
    // the row depends on the position.
    let drift = -view.readout_secs * view.twist.apparent_velocity(&observed.still);
    let z = observed.read.z;
    let row = Vector3::new(
        0.0,
        view.focal_px[1] / z,
        -view.focal_px[1] * observed.read.y / (z * z),
    );
    gradient - row * (gradient.dot(&drift) / (view.height_px + row.dot(&drift)))
}

/// Gradient with respect to the point at mid-exposure.
fn mid_exposure_gradient(
    view: &CorrectedView,
    observed: &ObservedPoint,
    row_held: &Vector3<f64>,
) -> Vector3<f64> {
    row_held - row_held.cross(&view.twist.angular_rad_s) * (observed.share * view.readout_secs)
}

/// Adds the derivatives with respect to the parameters that move a camera.
fn add_motion(
    param_columns: &ParamColumns<'_>,
    point: &Vector3<f64>,
    gradient: &Vector3<f64>,
    sign: f64,
    row: &mut [f64],
) {
    let lever = point.cross(gradient);
    for (param, linear, angular) in &param_columns.columns {
        row[*param] += sign * (linear.dot(gradient) + angular.dot(&lever));
    }
}

/// Adds the derivatives with respect to a motion of a point (translation, then rotation).
fn add_twist(row: &mut [f64], point: &Vector3<f64>, gradient: &Vector3<f64>, sign: f64) {
    let lever = point.cross(gradient);
    for axis in 0..3 {
        row[axis] += sign * gradient[axis];
        row[3 + axis] += sign * lever[axis];
    }
}

/// Adds the derivatives of parameters that move the sample's point within its own color camera.
fn add_depth(
    i: &ParamColumns<'_>,
    correspondence: &Correspondence,
    gradient: &Vector3<f64>,
    row: &mut [f64],
) {
    if let Some(pose) = i.depth_pose {
        add_twist(
            &mut row[pose..pose + 6],
            &correspondence.i.still,
            gradient,
            1.0,
        );
    }
    let in_depth = i.view.color_from_depth.rotation.tr_mul(gradient);
    if let Some(scale) = i.depth_scale {
        row[scale] += in_depth.dot(&correspondence.point_in_depth_i);
    }
    // The depth reading stays at its pixel, but the lens moves the ray of that pixel.
    if let (Some(lens), true) = (i.lens, i.view.shares_lens) {
        for axis in 0..2 {
            row[lens + axis] -= in_depth[axis] * correspondence.point_in_depth_i[axis];
            row[lens + 2 + axis] -=
                in_depth[axis] * correspondence.point_in_depth_i.z * i.view.keyframe_focal_px[axis]
                    / i.view.focal_px[axis];
        }
    }
}

/// Adds the derivatives with respect to the lens of a color camera. The point stays, and its pixel
/// moves.
fn add_lens(
    param_columns: &ParamColumns<'_>,
    observed: &ObservedPoint,
    factor: f64,
    row: &mut [f64],
) {
    let Some(lens) = param_columns.lens else {
        return;
    };
    for axis in 0..2 {
        let gradient = factor * observed.gradient[axis];
        row[lens + axis] +=
            gradient * (observed.pixel[axis] - param_columns.view.principal_px[axis]);
        row[lens + 2 + axis] += gradient * param_columns.view.keyframe_focal_px[axis];
    }
}
