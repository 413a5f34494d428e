//! Matches of corners between two images whose relative pose is approximately known.

use super::feature_image::{Corner, DESCRIPTOR_LEN, Descriptor, FeatureImage};
use super::moving_camera::{MovingCamera, Sighting};
use kinematics::Transform;
use nalgebra::{Matrix3, Vector2, Vector3};

/// Minimum normalized cross-correlation of a match. A lower value adds matches that are mostly
/// wrong. A higher value loses corners that are seen from different directions.
const MIN_CORRELATION: f32 = 0.75;
/// Maximum squared distance of the best match's descriptor, relative to the squared distance of the
/// second-best match.
const MAX_RATIO: f32 = 0.7;
/// Candidates closer than this to the best match, in texels, do not count as second best, because
/// they are the same corner on another level.
const SAME_CORNER_TEXELS: f64 = 3.0;
/// Maximum difference of the levels of two corners. One level is a factor of 1.5 in distance. With
/// a larger value, corners could be matched across larger ratios of distance, but there would be
/// more wrong matches.
const MAX_LEVEL_DIFFERENCE: usize = 1;

/// Two corners that show the same point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Match {
    /// The corners in the two images.
    pub(super) corners: [Corner; 2],
    /// Size of the larger corner's texels, radians.
    pub(super) texel_rad: f64,
}

/// The essential matrix of a relative pose.
///
/// * `translation_m`: position of the first camera in the frame of the second.
pub(super) fn essential(rotation: &Matrix3<f64>, translation_m: &Vector3<f64>) -> Matrix3<f64> {
    translation_m.cross_matrix() * rotation
}

/// Matches corners of one image with corners of another image.
///
/// * `cameras`: approximate poses of the two images.
/// * `tolerance_rad`: maximum distance of a match from its epipolar line.
pub(super) fn matches(
    from: &FeatureImage,
    to: &FeatureImage,
    cameras: [&MovingCamera; 2],
    tolerance_rad: f64,
) -> Vec<Match> {
    let to_from_from = cameras[1].world_from_camera.inverse() * cameras[0].world_from_camera;
    let rotation = to_from_from.rotation.to_rotation_matrix();
    // The motion of the second camera during readout is small compared with the tolerance.
    let rays: Vec<Vector2<f64>> = to
        .corners
        .iter()
        .map(|corner| cameras[1].sighting(corner).ray)
        .collect();
    // The descriptors of the second image are computed along the axes of the first image.
    // Descriptors need not be invariant to rotation, because the roll is known. They are therefore
    // more distinctive.
    let descriptors: Vec<Option<Descriptor>> = to
        .corners
        .iter()
        .map(|corner| to.rotated_descriptor(corner, roll(rotation.matrix(), &corner.ray)?))
        .collect();
    let mut best_of_to: Vec<(f32, usize)> = vec![(MIN_CORRELATION, usize::MAX); to.corners.len()];
    let mut best_of_from: Vec<Option<usize>> = vec![None; from.corners.len()];
    let mut candidates: Vec<(f32, usize)> = Vec::new();
    for (ix, corner) in from.corners.iter().enumerate() {
        let band = Band::new(&cameras[0].sighting(corner), &to_from_from, tolerance_rad);
        candidates.clear();
        for other_ix in to.corners_of_levels(corner.level, MAX_LEVEL_DIFFERENCE) {
            if !band.contains(&rays[other_ix]) {
                continue;
            }
            let Some(descriptor) = &descriptors[other_ix] else {
                continue;
            };
            let correlation = dot(&from.descriptors[ix], descriptor);
            candidates.push((correlation, other_ix));
            // The maximum is used for the check in the other direction, which therefore needs no
            // second search.
            if correlation > best_of_to[other_ix].0 {
                best_of_to[other_ix] = (correlation, ix);
            }
        }
        // If several matches are equal, the first match is used.
        let Some(best) = candidates
            .iter()
            .copied()
            .max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)))
        else {
            continue;
        };
        let best_corner = &to.corners[best.1];
        let same_rad = SAME_CORNER_TEXELS * to.texel_rad(best_corner);
        let is_distinct = |other: &Corner| (other.ray - best_corner.ray).norm() > same_rad;
        let second = candidates
            .iter()
            .filter(|(_, other)| is_distinct(&to.corners[*other]));
        let second = second
            .map(|(correlation, _)| *correlation)
            .fold(-1.0f32, f32::max);
        // The squared distance of two unit vectors is 2 - 2 times their dot product.
        if best.0 > MIN_CORRELATION && 1.0 - best.0 < MAX_RATIO * (1.0 - second) {
            best_of_from[ix] = Some(best.1);
        }
    }
    // Matches that are the best in both directions.
    let mut matches = Vec::new();
    for (ix, best) in best_of_from.into_iter().enumerate() {
        let Some(other_ix) = best.filter(|other_ix| best_of_to[*other_ix].1 == ix) else {
            continue;
        };
        let one = from.corners[ix];
        let other = to.corners[other_ix];
        matches.push(Match {
            corners: [one, other],
            texel_rad: from.texel_rad(&one).max(to.texel_rad(&other)),
        });
    }
    matches
}

/// Cosine and sine of the angle, at a ray, from the axes of the second image to the axes of the
/// first image.
fn roll(to_from_from: &Matrix3<f64>, ray: &Vector2<f64>) -> Option<[f64; 2]> {
    // The axes of the first image as seen in the second image are derivatives of the projection.
    let project = |axis: Vector3<f64>| axis.xy() - ray * axis.z;
    let x = project(to_from_from.column(0).into());
    let y = project(to_from_from.column(1).into());
    // This is the rotation nearest to the 2 x 2 matrix with these columns. If the sum is near zero,
    // the images look in opposite directions.
    let sum = Vector2::new(x.x + y.y, x.y - y.x).try_normalize(1e-6)?;
    Some(sum.into())
}

/// The area of an image in which the match of a corner is searched.
struct Band {
    /// Normal of the epipolar line and its offset. The distance from the line is `normal · ray +
    /// offset`.
    normal: Vector2<f64>,
    offset: f64,
    /// Position at which a very distant point appears, and the unit direction in which the point
    /// moves as it comes nearer.
    from_infinity: Option<(Vector2<f64>, Vector2<f64>)>,
    tolerance_rad: f64,
}

impl Band {
    fn new(corner: &Sighting, to_from_from: &Transform, tolerance_rad: f64) -> Self {
        let ray = corner.ray.push(1.0);
        let at_infinity = to_from_from.rotation * ray;
        let translation = to_from_from.transform_point(&corner.center_m.into()).coords;
        // The epipolar line contains the images of all points on the ray.
        let line = translation.cross(&at_infinity);
        let scale = line.xy().norm().max(f64::MIN_POSITIVE);
        // Points come from infinity to the epipole. Without a distant point in front of the second
        // camera, both directions are allowed.
        let from_infinity = (at_infinity.z > 0.1).then(|| {
            let position = at_infinity.xy() / at_infinity.z;
            let direction = (translation.xy() - position * translation.z).try_normalize(0.0);
            (position, direction.unwrap_or_default())
        });
        Self {
            normal: line.xy() / scale,
            offset: line.z / scale,
            from_infinity,
            tolerance_rad,
        }
    }

    /// Whether a ray is near the line, and on the side of points in front of the first camera.
    fn contains(&self, ray: &Vector2<f64>) -> bool {
        (self.normal.dot(ray) + self.offset).abs() < self.tolerance_rad
            && self.from_infinity.is_none_or(|(position, direction)| {
                (ray - position).dot(&direction) > -self.tolerance_rad
            })
    }
}

/// Dot product in eight independent sums, which compilers turn into vector instructions.
fn dot(a: &Descriptor, b: &Descriptor) -> f32 {
    const LANES: usize = 8;
    let mut sums = [0.0f32; LANES];
    for begin in (0..DESCRIPTOR_LEN).step_by(LANES) {
        for lane in 0..LANES {
            sums[lane] += a[begin + lane] * b[begin + lane];
        }
    }
    sums.iter().sum()
}
