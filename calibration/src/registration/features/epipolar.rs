//! Distances of matches from their epipolar lines, and their normal equations.

use super::matching::{Match, essential};
use super::moving_camera::{MovingCamera, Sighting};
use crate::registration::layout::Layout;
use crate::registration::pairs::Pair;
use crate::registration::sums::PairSums;
use kinematics::Transform;
use nalgebra::{DMatrix, DVector, Matrix3, Vector2, Vector3};
use std::collections::BTreeMap;

/// Number of standard deviations at which residuals get half the full weight (Cauchy weights).
const CAUCHY_SCALE: f64 = 2.385;
/// Number of parts of a rigid motion.
const N_PARTS: usize = 6;

/// Distance of a match from its epipolar line, radians near the image center. It is the first-order
/// approximation of the smallest motion of both corners that makes their rays meet (Sampson 1982).
struct Sampson {
    rays: [Vector3<f64>; 2],
    numerator: f64,
    /// Derivatives of the numerator by the coordinates of the corners, with a third coordinate of
    /// 0.
    gradients: [Vector3<f64>; 2],
    norm: f64,
}

impl Sampson {
    /// * `rotation`, `translation_m`: pose of the first camera in the frame of the second, both at
    ///   mid-exposure.
    fn new(
        rotation: &Matrix3<f64>,
        translation_m: &Vector3<f64>,
        [one, other]: &[Sighting; 2],
    ) -> Self {
        let rays = [one.ray, other.ray].map(|ray| ray.push(1.0));
        // The relative pose at the readout of the two rows.
        let essential = essential(
            rotation,
            &(translation_m + rotation * one.center_m - other.center_m),
        );
        let line = essential * rays[0];
        let other_line = essential.tr_mul(&rays[1]);
        let gradients = [other_line, line].map(|line| Vector3::new(line.x, line.y, 0.0));
        let norm = (gradients[0].norm_squared() + gradients[1].norm_squared())
            .sqrt()
            .max(f64::MIN_POSITIVE);
        Self {
            rays,
            numerator: rays[1].dot(&line),
            gradients,
            norm,
        }
    }

    /// The signed distance.
    fn distance_rad(&self) -> f64 {
        self.numerator / self.norm
    }

    /// Derivatives of the distance by the elements of the essential matrix.
    fn derivatives(&self) -> Matrix3<f64> {
        // This is the quotient rule for numerator / norm. The numerator is linear in the essential
        // matrix, and the squared norm is quadratic.
        let by_norm = self.gradients[1] * self.rays[0].transpose()
            + self.rays[1] * self.gradients[0].transpose();
        let by_numerator = self.rays[1] * self.rays[0].transpose();
        (by_numerator - by_norm * (self.numerator / (self.norm * self.norm))) / self.norm
    }
}

/// Derivatives of the essential matrix by motions of the two cameras in their own axes. The order
/// is: translation and rotation of the first camera, then of the second camera.
fn essential_derivatives(to_from_from: &Transform) -> [[Matrix3<f64>; N_PARTS]; 2] {
    let rotation = *to_from_from.rotation.to_rotation_matrix().matrix();
    let cross = to_from_from.translation.vector.cross_matrix();
    let of_first = std::array::from_fn(|part| {
        let axis = Vector3::ith(part % 3, 1.0);
        if part < 3 {
            (rotation * axis).cross_matrix() * rotation
        } else {
            cross * rotation * axis.cross_matrix()
        }
    });
    let of_second = std::array::from_fn(|part| {
        let axis = Vector3::ith(part % 3, 1.0);
        // A rotation of both factors of the essential matrix from the left rotates the matrix.
        if part < 3 {
            -axis.cross_matrix() * rotation
        } else {
            -axis.cross_matrix() * cross * rotation
        }
    });
    [of_first, of_second]
}

/// The matches of two images.
#[derive(Clone, Debug)]
pub(super) struct PairMatches {
    pub(super) pair: Pair,
    pub(super) cameras: [usize; 2],
    pub(super) matches: Vec<Match>,
    /// Half the width of the band in which the matches were searched.
    pub(super) band_rad: f64,
}

impl PairMatches {
    /// Pose of the first camera in the frame of the second camera.
    fn to_from_from(&self, cameras: &[MovingCamera]) -> Transform {
        cameras[self.pair.to].world_from_camera.inverse()
            * cameras[self.pair.from].world_from_camera
    }

    /// The matches relative to their epipolar lines.
    fn sampsons<'a>(
        &'a self,
        cameras: &'a [MovingCamera],
        to_from_from: &Transform,
    ) -> impl Iterator<Item = (&'a Match, Sampson)> {
        let rotation = to_from_from.rotation.to_rotation_matrix().into_inner();
        let translation_m = to_from_from.translation.vector;
        let pair = [&cameras[self.pair.from], &cameras[self.pair.to]];
        self.matches.iter().map(move |found| {
            let sightings = std::array::from_fn(|ix| pair[ix].sighting(&found.corners[ix]));
            (found, Sampson::new(&rotation, &translation_m, &sightings))
        })
    }

    /// Distances from the epipolar lines, radians near the image center.
    pub(super) fn distances_rad(&self, cameras: &[MovingCamera]) -> Vec<f64> {
        let to_from_from = self.to_from_from(cameras);
        self.sampsons(cameras, &to_from_from)
            .map(|(_, sampson)| sampson.distance_rad())
            .collect()
    }

    /// Distances from the epipolar lines, texels.
    pub(super) fn distances_texels(&self, cameras: &[MovingCamera]) -> Vec<f64> {
        let distances = self.distances_rad(cameras).into_iter().zip(&self.matches);
        distances
            .map(|(distance, found)| distance / found.texel_rad)
            .collect()
    }

    /// Contribution to the normal equations. The derivatives neglect the motion during readout,
    /// which is small compared with the distance between the cameras.
    ///
    /// * `noise_texels`: standard deviation of the distances.
    pub(super) fn sums(
        &self,
        cameras: &[MovingCamera],
        layout: &Layout,
        noise_texels: f64,
    ) -> PairSums {
        let to_from_from = self.to_from_from(cameras);
        let pair_cameras = [&cameras[self.pair.from], &cameras[self.pair.to]];
        // If both images are from one camera, its parameters change both. Lens parameters do not
        // change the essential matrix, so their entries are zero.
        let mut derivatives: BTreeMap<usize, Matrix3<f64>> = BTreeMap::new();
        for (ix, by_motion) in essential_derivatives(&to_from_from).into_iter().enumerate() {
            for (param, translation, rotation) in pair_cameras[ix].motions(layout, self.cameras[ix])
            {
                let parts = translation.iter().chain(&rotation).zip(&by_motion);
                *derivatives.entry(param).or_default() += parts
                    .map(|(length, by_part)| by_part * *length)
                    .sum::<Matrix3<f64>>();
            }
            for (param, _) in pair_cameras[ix]
                .ray_motions(layout, self.cameras[ix], &Vector2::zeros())
                .into_iter()
                .flatten()
            {
                derivatives.entry(param).or_default();
            }
        }
        let (params, derivatives): (Vec<usize>, Vec<Matrix3<f64>>) =
            derivatives.into_iter().unzip();
        let n = params.len();
        let mut information = DMatrix::zeros(n, n);
        let mut gradient = DVector::zeros(n);
        let mut row = vec![0.0; n];
        for (found, sampson) in self.sampsons(cameras, &to_from_from) {
            let scale = 1.0 / (noise_texels * found.texel_rad);
            let residual = scale * sampson.distance_rad();
            let weight = 1.0 / (1.0 + (residual / CAUCHY_SCALE).powi(2));
            let by_essential = sampson.derivatives() * scale;
            row.iter_mut()
                .zip(&derivatives)
                .for_each(|(value, derivative)| *value = by_essential.dot(derivative));
            // A lens parameter moves the ray in each image, and the gradient gives the effect on
            // the distance.
            for (ix, camera) in pair_cameras.into_iter().enumerate() {
                let by_ray = sampson.gradients[ix].xy() * (scale / sampson.norm);
                for (param, motion) in camera
                    .ray_motions(layout, self.cameras[ix], &sampson.rays[ix].xy())
                    .into_iter()
                    .flatten()
                {
                    row[params.partition_point(|other| *other < param)] += by_ray.dot(&motion);
                }
            }
            // Only the lower triangle is updated, because this code runs for every match in every
            // iteration.
            for (ix, value) in row.iter().enumerate() {
                let weighted = weight * value;
                gradient[ix] -= weighted * residual;
                for (other_ix, other) in row[..=ix].iter().enumerate() {
                    information[(ix, other_ix)] += weighted * other;
                }
            }
        }
        information.fill_upper_triangle_with_lower_triangle();
        PairSums::new(params, information, gradient)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ParamSet;
    use crate::registration::corrections::Corrections;
    use crate::registration::features::feature_image::Corner;
    use crate::scenes::{Miscalibration, capture};
    use kinematics::{Twist, transform};

    #[test]
    fn derivatives_match_finite_differences() {
        const STEP: f64 = 1e-6;
        let pose = Transform::new(Vector3::new(0.3, -0.1, 0.05), Vector3::new(0.1, -0.3, 0.5));
        let rays = [Vector2::new(0.2, -0.3), Vector2::new(-0.1, 0.4)];
        let sightings = rays.map(|ray| Sighting {
            ray,
            center_m: Vector3::zeros(),
        });
        let sampson_at = |pose: &Transform| {
            Sampson::new(
                pose.rotation.to_rotation_matrix().matrix(),
                &pose.translation.vector,
                &sightings,
            )
        };
        let sampson = sampson_at(&pose);
        for (ix, derivative) in essential_derivatives(&pose).iter().flatten().enumerate() {
            let at = |sign: f64| {
                let mut twist = Twist::zero();
                let part = if ix % 6 < 3 {
                    &mut twist.linear_m_s
                } else {
                    &mut twist.angular_rad_s
                };
                part[ix % 3] = sign * STEP;
                let moved = if ix < 6 {
                    pose * transform::exp(&twist, 1.0)
                } else {
                    transform::exp(&twist, -1.0) * pose
                };
                sampson_at(&moved).distance_rad()
            };
            let numeric = (at(1.0) - at(-1.0)) / (2.0 * STEP);
            let analytic = sampson.derivatives().dot(derivative);
            assert!(
                (numeric - analytic).abs() < 1e-7,
                "{ix}: {analytic}, numerically {numeric}"
            );
        }
    }

    #[test]
    fn derivatives_by_all_parameters_match_finite_differences() {
        const STEP: f64 = 1e-6;
        const NOISE_TEXELS: f64 = 1.0;
        let scan = capture(&Miscalibration {
            has_rolling_shutter: true,
            ..Miscalibration::none()
        });
        let keyframes = [&*scan[4], &*scan[12]];
        let images = keyframes.map(|keyframe| (0, keyframe));
        let layout = Layout::new(
            ParamSet::EXTRINSICS | ParamSet::TIME_OFFSET | ParamSet::LENS,
            &images,
            1,
        );
        // A camera whose pixels are not at the principal point, so that no derivative is zero.
        let corners = [
            Corner::at([30.0, 90.0], -0.2),
            Corner::at([120.0, 40.0], 0.3),
        ];
        let pair = PairMatches {
            pair: Pair { from: 0, to: 1 },
            cameras: [0, 0],
            matches: vec![Match {
                corners,
                texel_rad: 0.003,
            }],
            band_rad: 0.1,
        };
        let cameras = |step: &DVector<f64>| {
            let mut corrections = Corrections::none(1);
            corrections.apply_step(&layout, step);
            keyframes
                .map(|keyframe| MovingCamera::new(keyframe, &corrections.by_camera[0]))
                .to_vec()
        };
        let none = DVector::zeros(layout.n());
        let sums = pair.sums(&cameras(&none), &layout, NOISE_TEXELS);
        let residual =
            |step: &DVector<f64>| pair.distances_texels(&cameras(step))[0] / NOISE_TEXELS;
        let weight = 1.0 / (1.0 + (residual(&none) / CAUCHY_SCALE).powi(2));
        for (row, param) in sums.params.iter().enumerate() {
            let at = |sign: f64| {
                let mut step = none.clone();
                step[*param] = sign * STEP;
                residual(&step)
            };
            let numeric = (at(1.0) - at(-1.0)) / (2.0 * STEP);
            let analytic = -sums.gradient[row] / (weight * residual(&none));
            let tolerance = 0.1 * numeric.abs() + 1e-3; // Neglects the motion during readout and the norm's derivative.
            assert!(
                (numeric - analytic).abs() < tolerance,
                "{row}: {analytic}, numerically {numeric}"
            );
        }
    }
}
