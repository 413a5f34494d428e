//! Distances of matches from their epipolar lines, and their normal equations.

use super::matching::{Match, essential};
use crate::registration::layout::Layout;
use crate::registration::pairs::Pair;
use crate::registration::sums::PairSums;
use kinematics::Transform;
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use std::collections::BTreeMap;

/// Number of standard deviations at which residuals get half the full weight (Cauchy weights).
const CAUCHY_SCALE: f64 = 2.385;
/// Number of parameters of the extrinsics of one camera.
const N_PARTS: usize = 6;

/// Distance of a match from its epipolar line: the first-order approximation of the smallest motion of both corners that
/// makes their rays meet (Sampson 1982), radians near the image center.
struct Sampson {
    rays: [Vector3<f64>; 2],
    numerator: f64,
    /// Derivatives of the numerator by the coordinates of the corners, with a third coordinate of 0.
    gradients: [Vector3<f64>; 2],
    norm: f64,
}

impl Sampson {
    fn new(essential: &Matrix3<f64>, found: &Match) -> Self {
        let rays = found.rays.map(|ray| ray.push(1.0));
        let (line, other_line) = (essential * rays[0], essential.tr_mul(&rays[1]));
        let gradients = [other_line, line].map(|line| Vector3::new(line.x, line.y, 0.0));
        let norm = (gradients[0].norm_squared() + gradients[1].norm_squared()).sqrt().max(f64::MIN_POSITIVE);
        Self { rays, numerator: rays[1].dot(&line), gradients, norm }
    }

    fn distance_rad(&self) -> f64 {
        self.numerator / self.norm
    }

    /// Derivatives of the distance by the elements of the essential matrix.
    fn derivatives(&self) -> Matrix3<f64> {
        let by_norm = self.gradients[1] * self.rays[0].transpose() + self.rays[1] * self.gradients[0].transpose();
        let by_numerator = self.rays[1] * self.rays[0].transpose();
        (by_numerator - by_norm * (self.numerator / (self.norm * self.norm))) / self.norm
    }
}

/// Derivatives of the essential matrix by motions of the two cameras in their own axes: translation, then rotation, of
/// the first camera, then of the second.
fn essential_derivatives(to_from_from: &Transform) -> [Matrix3<f64>; 2 * N_PARTS] {
    let rotation = *to_from_from.rotation.to_rotation_matrix().matrix();
    let cross = to_from_from.translation.vector.cross_matrix();
    std::array::from_fn(|ix| {
        let axis = Vector3::ith(ix % 3, 1.0);
        match ix / 3 {
            0 => (rotation * axis).cross_matrix() * rotation,
            1 => cross * rotation * axis.cross_matrix(),
            2 => -axis.cross_matrix() * rotation,
            // Rotating both parts of the essential matrix from the left rotates the matrix.
            _ => -axis.cross_matrix() * cross * rotation,
        }
    })
}

/// The matches of two images.
#[derive(Clone, Debug)]
pub(super) struct PairMatches {
    pub(super) pair: Pair,
    pub(super) cameras: [usize; 2],
    pub(super) matches: Vec<Match>,
    /// Half the width of the band in which they were searched.
    pub(super) band_rad: f64,
}

impl PairMatches {
    fn to_from_from(&self, poses: &[Transform]) -> Transform {
        poses[self.pair.to].inverse() * poses[self.pair.from]
    }

    /// Distances from the epipolar lines, radians near the image center.
    pub(super) fn distances_rad(&self, poses: &[Transform]) -> Vec<f64> {
        let essential = essential(&self.to_from_from(poses));
        self.matches.iter().map(|found| Sampson::new(&essential, found).distance_rad()).collect()
    }

    /// Distances from the epipolar lines, texels.
    pub(super) fn distances_texels(&self, poses: &[Transform]) -> Vec<f64> {
        let distances = self.distances_rad(poses).into_iter().zip(&self.matches);
        distances.map(|(distance, found)| distance / found.texel_rad).collect()
    }

    /// Contribution to the normal equations.
    ///
    /// * `noise_texels`: standard deviation of the distances.
    pub(super) fn sums(&self, poses: &[Transform], layout: &Layout, noise_texels: f64) -> PairSums {
        sums(self, &self.to_from_from(poses), layout, noise_texels)
    }
}

fn sums(pair: &PairMatches, to_from_from: &Transform, layout: &Layout, noise_texels: f64) -> PairSums {
    let essential = essential(to_from_from);
    let begins = pair.cameras.map(|camera| layout.of_camera(camera).extrinsics);
    // If both images are from one camera, its motion moves both.
    let mut derivatives: BTreeMap<usize, Matrix3<f64>> = BTreeMap::new();
    for (ix, derivative) in essential_derivatives(to_from_from).into_iter().enumerate() {
        if let Some(begin) = begins[ix / N_PARTS] {
            *derivatives.entry(begin + ix % N_PARTS).or_default() += derivative;
        }
    }
    let (params, derivatives): (Vec<usize>, Vec<Matrix3<f64>>) = derivatives.into_iter().unzip();
    let n = params.len();
    let (mut information, mut gradient) = (DMatrix::zeros(n, n), DVector::zeros(n));
    let mut row = vec![0.0; n];
    for found in &pair.matches {
        let sampson = Sampson::new(&essential, found);
        let scale = 1.0 / (noise_texels * found.texel_rad);
        let residual = scale * sampson.distance_rad();
        let weight = 1.0 / (1.0 + (residual / CAUCHY_SCALE).powi(2));
        let by_essential = sampson.derivatives() * scale;
        row.iter_mut().zip(&derivatives).for_each(|(value, derivative)| *value = by_essential.dot(derivative));
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

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::{Twist, transform};
    use nalgebra::Vector2;

    #[test]
    fn derivatives_match_finite_differences() {
        const STEP: f64 = 1e-6;
        let pose = Transform::new(Vector3::new(0.3, -0.1, 0.05), Vector3::new(0.1, -0.3, 0.5));
        let found = Match { rays: [Vector2::new(0.2, -0.3), Vector2::new(-0.1, 0.4)], texel_rad: 0.003 };
        let sampson = Sampson::new(&essential(&pose), &found);
        for (ix, derivative) in essential_derivatives(&pose).iter().enumerate() {
            let at = |sign: f64| {
                let mut twist = Twist::zero();
                let part = if ix % 6 < 3 { &mut twist.linear_m_s } else { &mut twist.angular_rad_s };
                part[ix % 3] = sign * STEP;
                let moved =
                    if ix < 6 { pose * transform::exp(&twist, 1.0) } else { transform::exp(&twist, -1.0) * pose };
                Sampson::new(&essential(&moved), &found).distance_rad()
            };
            let numeric = (at(1.0) - at(-1.0)) / (2.0 * STEP);
            let analytic = sampson.derivatives().dot(derivative);
            assert!((numeric - analytic).abs() < 1e-7, "{ix}: {analytic}, numerically {numeric}");
        }
    }
}
