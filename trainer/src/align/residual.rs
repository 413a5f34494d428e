//! A spot of one frame in another: differences of brightness and of depth, and how they change with every term.
//!
//! A reading of depth becomes a point in the world. Its brightness where frame `i` shows it is compared with that where frame
//! `j` shows it, and its distance along z from `j`'s depth camera with the reading there. Source: Kerbl, Sturm and Cremers 2013
//! (the two residuals), Schoeps et al. 2019 (both cameras move); that depth has its own pose, and the shutter, are ours.

use super::frame::{Frame, Grey, Spot, depth_at, point};
use super::view::View;
use nalgebra::Vector3;

/// One image is as fine as another up to this factor.
const HALF_AN_OCTAVE: f64 = std::f64::consts::SQRT_2;

/// A frame with its cameras.
#[derive(Clone, Copy)]
pub(super) struct Side<'a> {
    pub(super) frame: &'a Frame,
    pub(super) view: &'a View,
}

/// A point as one of the two frames has it.
#[derive(Clone, Copy, Debug)]
struct Seen {
    /// In the color camera at mid-exposure.
    still: Vector3<f64>,
    /// When its row is read.
    read: Vector3<f64>,
    /// The row's share of the readout.
    share: f64,
    pixel: [f64; 2],
    brightness: f64,
    slope: [f64; 2],
}

/// A spot of frame `i` in frame `j`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Look {
    i: Seen,
    j: Seen,
    /// The spot in the depth camera of `i`, and the point in that of `j`.
    from_depth: Vector3<f64>,
    in_depth: Vector3<f64>,
    depth_pixel: [f64; 2],
    reading_m: f64,
    reading_slope: [f64; 2],
    depth_weight: f64,
}

/// How brightness of `i` becomes that of `j`: exposures differ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tone {
    pub(super) gain: f64,
    pub(super) offset: f64,
}

impl Look {
    /// None where `j` does not show it: outside, hidden, at edges and holes. Readings may be off by `hidden_frac` of depth.
    pub(super) fn new(i: Side<'_>, j: Side<'_>, spot: &Spot, level: usize, hidden_frac: f64) -> Option<Self> {
        let from_depth = point(i.view.depth_focal_px, i.view.depth_principal_px, spot) * i.view.depth_factor;
        let in_i = i.view.color_from_depth.then(&from_depth);
        let in_j = j.view.world_from_camera.back(&i.view.world_from_camera.then(&in_i));
        let in_depth = j.view.color_from_depth.back(&in_j);
        if !(in_i.z > 0.0 && in_j.z > 0.0 && in_depth.z > 0.0) {
            return None;
        }
        let depth_pixel = j.view.depth_pixel(&in_depth);
        let reading = depth_at(j.frame.keyframe.depth.as_ref()?, depth_pixel)?;
        let factor = j.view.depth_factor;
        let (reading_m, reading_slope) = (factor * reading.value, reading.slope.map(|slope| factor * slope));
        if (reading_m - in_depth.z).abs() > hidden_frac * reading_m {
            return None;
        }
        let tilt = [0, 1].map(|axis| reading_slope[axis] * j.view.depth_focal_px[axis] / reading_m);
        let [level_i, level_j] = levels([i, j], [in_i.z, in_j.z], level);
        Some(Self {
            i: Seen::new(i.view, in_i, i.frame.level(level_i))?,
            j: Seen::new(j.view, in_j, j.frame.level(level_j))?,
            from_depth,
            in_depth,
            depth_pixel,
            reading_m,
            reading_slope,
            // Along the normal instead of along z; noise of depth grows with its square.
            depth_weight: 1.0 / ((1.0 + tilt[0] * tilt[0] + tilt[1] * tilt[1]).sqrt() * reading_m * reading_m),
        })
    }

    /// Where `j` shows it.
    pub(super) fn pixel(&self) -> [f64; 2] {
        self.j.pixel
    }

    pub(super) fn brightness(&self) -> [f64; 2] {
        [self.i.brightness, self.j.brightness]
    }

    /// Of 255.
    pub(super) fn photo(&self, tone: Tone) -> f64 {
        self.j.brightness - tone.gain * self.i.brightness - tone.offset
    }

    /// Along the normal at 1 m, metres.
    pub(super) fn depth(&self) -> f64 {
        self.depth_weight * (self.reading_m - self.in_depth.z)
    }

    /// Slopes of [`Look::photo`] along the terms; those of gain and offset come after them.
    pub(super) fn photo_slopes(&self, i: &Placed<'_>, j: &Placed<'_>, tone: Tone, row: &mut [f64]) {
        row.fill(0.0);
        let read_j = held_slope(j.view, &self.j, &along_point(j.view, &self.j, 1.0));
        let read_i = held_slope(i.view, &self.i, &along_point(i.view, &self.i, -tone.gain));
        let (slope_j, slope_i) = (still_slope(j.view, &self.j, &read_j), still_slope(i.view, &self.i, &read_i));
        let through = i.view.world_from_camera.rotation.tr_mul(&(j.view.world_from_camera.rotation * slope_j));
        add_motion(i, &self.i.still, &through, 1.0, row);
        add_motion(j, &self.j.still, &slope_j, -1.0, row);
        add_depth(i, self, &(through + slope_i), row);
        add_lens(i, &self.i, -tone.gain, row);
        add_lens(j, &self.j, 1.0, row);
        for (placed, seen, read) in [(i, &self.i, &read_i), (j, &self.j, &read_j)] {
            if let Some(readout) = placed.readout {
                row[readout] += seen.share * read.dot(&placed.view.twist.apparent_velocity(&seen.still));
            }
        }
        let n = row.len();
        (row[n - 2], row[n - 1]) = (-self.i.brightness, -1.0);
    }

    /// Slopes of [`Look::depth`] along the terms; gain and offset have none.
    pub(super) fn depth_slopes(&self, i: &Placed<'_>, j: &Placed<'_>, row: &mut [f64]) {
        row.fill(0.0);
        let weight = self.depth_weight;
        let [fx, fy] = j.view.depth_focal_px;
        let q = &self.in_depth;
        let [sx, sy] = self.reading_slope;
        let along_z = -(sx * fx * q.x + sy * fy * q.y) / (q.z * q.z) - 1.0;
        let in_depth = Vector3::new(sx * fx / q.z, sy * fy / q.z, along_z) * weight;
        let slope_j = j.view.color_from_depth.rotation * in_depth;
        let through = i.view.world_from_camera.rotation.tr_mul(&(j.view.world_from_camera.rotation * slope_j));
        add_motion(i, &self.i.still, &through, 1.0, row);
        add_motion(j, &self.j.still, &slope_j, -1.0, row);
        add_depth(i, self, &through, row);
        if let Some(pose) = j.depth_pose {
            add_twist(&mut row[pose..pose + 6], &self.j.still, &slope_j, -1.0);
        }
        if let Some(scale) = j.depth_scale {
            row[scale] += weight * self.reading_m;
        }
        if let (Some(lens), true) = (j.lens, j.view.shares_lens) {
            for axis in 0..2 {
                let slope = weight * self.reading_slope[axis];
                row[lens + axis] += slope * (self.depth_pixel[axis] - j.view.depth_principal_px[axis]);
                let raw_share = j.view.raw_focal_px[axis] / j.view.focal_px[axis];
                row[lens + 2 + axis] += slope * j.view.depth_focal_px[axis] * raw_share;
            }
        }
    }
}

/// Levels at which both images show a surface about equally fine, neither finer than asked for: a near view has detail that a
/// far one cannot have.
fn levels([i, j]: [Side<'_>; 2], [z_i, z_j]: [f64; 2], level: usize) -> [usize; 2] {
    let texel_m = |side: Side<'_>, z_m: f64| z_m * side.frame.level(level).texel_px() / side.view.focal_px[0];
    let (of_i, of_j) = (texel_m(i, z_i), texel_m(j, z_j));
    let octaves = |share: f64| (0..3).take_while(|octave| share > HALF_AN_OCTAVE * f64::from(1 << octave)).count();
    [level + octaves(of_j / of_i), level + octaves(of_i / of_j)]
}

impl Seen {
    fn new(view: &View, still: Vector3<f64>, grey: &Grey) -> Option<Self> {
        let (read, share) = view.when_read(&still);
        let pixel = view.pixel(&read);
        let seen = grey.at(pixel)?;
        Some(Self { still, read, share, pixel, brightness: seen.value, slope: seen.slope })
    }
}

/// Where the terms of a view lie in the rows of a pair.
#[derive(Debug)]
pub(super) struct Placed<'a> {
    view: &'a View,
    columns: Vec<(usize, Vector3<f64>, Vector3<f64>)>,
    depth_pose: Option<usize>,
    lens: Option<usize>,
    depth_scale: Option<usize>,
    readout: Option<usize>,
}

impl<'a> Placed<'a> {
    /// `place` says where in the rows a term lies.
    pub(super) fn new(view: &'a View, place: impl Fn(usize) -> usize) -> Self {
        Self {
            columns: view.columns.iter().map(|(term, linear, angular)| (place(*term), *linear, *angular)).collect(),
            depth_pose: view.depth_pose.map(&place),
            lens: view.lens.map(&place),
            depth_scale: view.depth_scale.map(&place),
            readout: view.readout.map(&place),
            view,
        }
    }

    /// Only the motion of the camera itself: metres, then radians, from `begin` on.
    pub(super) fn free(view: &'a View, begin: usize) -> Self {
        let unit = |axis: usize| Vector3::from_fn(|row, _| if row == axis { 1.0 } else { 0.0 });
        let motion = |part: usize| match part {
            0..3 => (begin + part, unit(part), Vector3::zeros()),
            _ => (begin + part, Vector3::zeros(), unit(part - 3)),
        };
        let columns = (0..6).map(motion).collect();
        Self { columns, ..Self::still(view) }
    }

    /// Nothing changes.
    pub(super) fn still(view: &'a View) -> Self {
        Self { view, columns: Vec::new(), depth_pose: None, lens: None, depth_scale: None, readout: None }
    }
}

/// How `factor` times the brightness changes with the point at the time its row is read.
fn along_point(view: &View, seen: &Seen, factor: f64) -> Vector3<f64> {
    let [sx, sy] = [0, 1].map(|axis| factor * seen.slope[axis] * view.focal_px[axis] / seen.read.z);
    Vector3::new(sx, sy, -(sx * seen.read.x + sy * seen.read.y) / seen.read.z)
}

/// The same with the point as it moves while the row that reads it is held: a point that moves on meets another row.
fn held_slope(view: &View, seen: &Seen, slope: &Vector3<f64>) -> Vector3<f64> {
    let drift = -view.readout_secs * view.twist.apparent_velocity(&seen.still);
    let z = seen.read.z;
    let row = Vector3::new(0.0, view.focal_px[1] / z, -view.focal_px[1] * seen.read.y / (z * z));
    slope - row * (slope.dot(&drift) / (view.height_px + row.dot(&drift)))
}

/// The same with the point at mid-exposure.
fn still_slope(view: &View, seen: &Seen, held: &Vector3<f64>) -> Vector3<f64> {
    held - held.cross(&view.twist.angular_rad_s) * (seen.share * view.readout_secs)
}

fn add_motion(placed: &Placed<'_>, point: &Vector3<f64>, slope: &Vector3<f64>, sign: f64, row: &mut [f64]) {
    let lever = point.cross(slope);
    for (term, linear, angular) in &placed.columns {
        row[*term] += sign * (linear.dot(slope) + angular.dot(&lever));
    }
}

fn add_twist(row: &mut [f64], point: &Vector3<f64>, slope: &Vector3<f64>, sign: f64) {
    let lever = point.cross(slope);
    for axis in 0..3 {
        row[axis] += sign * slope[axis];
        row[3 + axis] += sign * lever[axis];
    }
}

/// What moves the point of a spot within its own color camera.
fn add_depth(i: &Placed<'_>, look: &Look, slope: &Vector3<f64>, row: &mut [f64]) {
    if let Some(pose) = i.depth_pose {
        add_twist(&mut row[pose..pose + 6], &look.i.still, slope, 1.0);
    }
    let in_depth = i.view.color_from_depth.rotation.tr_mul(slope);
    if let Some(scale) = i.depth_scale {
        row[scale] += in_depth.dot(&look.from_depth);
    }
    if let (Some(lens), true) = (i.lens, i.view.shares_lens) {
        for axis in 0..2 {
            row[lens + axis] -= in_depth[axis] * look.from_depth[axis];
            row[lens + 2 + axis] -=
                in_depth[axis] * look.from_depth.z * i.view.raw_focal_px[axis] / i.view.focal_px[axis];
        }
    }
}

fn add_lens(placed: &Placed<'_>, seen: &Seen, factor: f64, row: &mut [f64]) {
    let Some(lens) = placed.lens else { return };
    for axis in 0..2 {
        let slope = factor * seen.slope[axis];
        row[lens + axis] += slope * (seen.pixel[axis] - placed.view.principal_px[axis]);
        row[lens + 2 + axis] += slope * placed.view.raw_focal_px[axis];
    }
}
