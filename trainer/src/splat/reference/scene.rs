//! Small scenes and cameras for tests of the reference and of the kernels.

use super::{RenderedImage, Splat, Upstream, View};
pub(crate) use crate::random::F32Random;
use kinematics::Transform;
use nalgebra::{Point3, Vector3};

/// Number of spherical-harmonic coefficients for degrees 0 to 3.
pub(crate) const N_COEFFS: [usize; 4] = [1, 4, 9, 16];

/// A static camera that looks at the world's origin from 2 m away. It is rotated about all axes and
/// has unequal focal lengths and an off-center principal point, so that no gradient term is zero.
pub(crate) fn tilted_view() -> View {
    let world_from_camera = Transform::face_towards(
        &Point3::new(1.1, -1.5, 0.8),
        &Point3::new(0.05, -0.02, 0.04),
        &Vector3::new(0.3, 0.2, -1.0),
    );
    View {
        camera_from_world: world_from_camera.inverse(),
        focal_px: [31.0, 28.0],
        principal_px: [13.3, 10.4],
        size_px: [28, 20],
        near_m: 0.05,
        linear_m: [0.0; 3],
        angular_rad: [0.0; 3],
        is_antialiased: false,
    }
}

/// [`tilted_view`] with a camera that translates and rotates by a few pixels during readout.
pub(crate) fn rolling_view() -> View {
    View {
        linear_m: [0.12, -0.09, 0.15],
        angular_rad: [0.05, -0.08, 0.11],
        ..tilted_view()
    }
}

/// `n` overlapping splats, cycling through all degrees, in front of [`tilted_view`].
///
/// Colors stay above 0, opacities are between 0.15 and 0.95, and rotations do not have unit length.
pub(crate) fn small_scene(seed: u64, n: usize) -> Vec<Splat> {
    let mut random = F32Random::new(seed);
    let splat = |splat_ix: usize| Splat {
        mean: random.array(-0.45, 0.45),
        log_scale: random.array(-3.2, -1.4),
        rotation_wxyz: random.array(-1.5, 1.5),
        opacity_logit: random.uniform(-1.7, 2.9),
        sh: colorful(&mut random, N_COEFFS[splat_ix % N_COEFFS.len()]),
    };
    (0..n).map(splat).collect()
}

fn colorful(random: &mut F32Random, n_coeffs: usize) -> Vec<[f64; 3]> {
    let mut sh = vec![random.array(-0.6, 1.4)];
    sh.resize_with(n_coeffs, || random.array(-0.08, 0.08));
    sh
}

/// A random gradient with respect to every number of an image, between -1 and 1.
pub(crate) fn some_upstream(seed: u64, view: &View) -> Upstream {
    let mut random = F32Random::new(seed);
    let n_pixels = view.n_pixels();
    Upstream {
        rgb: (0..n_pixels).map(|_| random.array(-1.0, 1.0)).collect(),
        transmittance: (0..n_pixels).map(|_| random.uniform(-1.0, 1.0)).collect(),
        depth: (0..n_pixels).map(|_| random.uniform(-1.0, 1.0)).collect(),
    }
}

impl Upstream {
    /// A loss that is linear in the image, with `self` as its gradient.
    pub(crate) fn dot(&self, image: &RenderedImage) -> f64 {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        dot(self.rgb.as_flattened(), image.rgb.as_flattened())
            + dot(&self.transmittance, &image.transmittance)
            + dot(&self.depth, &image.depth)
    }
}

/// Identifies one raw value of a splat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum SplatParam {
    Mean(usize),
    LogScale(usize),
    RotationWxyz(usize),
    OpacityLogit,
    Sh(usize, usize),
}

impl Splat {
    /// Every raw value of this splat.
    pub(crate) fn params(&self) -> Vec<SplatParam> {
        let mut params = vec![SplatParam::OpacityLogit];
        params.extend((0..3).map(SplatParam::Mean));
        params.extend((0..3).map(SplatParam::LogScale));
        params.extend((0..4).map(SplatParam::RotationWxyz));
        params.extend(
            (0..self.sh.len())
                .flat_map(|coeff_ix| (0..3).map(move |channel| SplatParam::Sh(coeff_ix, channel))),
        );
        params
    }

    /// One raw value (or its gradient, for a `SplatGrad`).
    pub(crate) fn get(&self, param: SplatParam) -> f64 {
        match param {
            SplatParam::Mean(axis) => self.mean[axis],
            SplatParam::LogScale(axis) => self.log_scale[axis],
            SplatParam::RotationWxyz(ix) => self.rotation_wxyz[ix],
            SplatParam::OpacityLogit => self.opacity_logit,
            SplatParam::Sh(coeff_ix, channel) => self.sh[coeff_ix][channel],
        }
    }

    /// This splat with `nudge` added to one raw value.
    pub(crate) fn nudged(&self, param: SplatParam, nudge: f64) -> Self {
        let mut splat = self.clone();
        *match param {
            SplatParam::Mean(axis) => &mut splat.mean[axis],
            SplatParam::LogScale(axis) => &mut splat.log_scale[axis],
            SplatParam::RotationWxyz(ix) => &mut splat.rotation_wxyz[ix],
            SplatParam::OpacityLogit => &mut splat.opacity_logit,
            SplatParam::Sh(coeff_ix, channel) => &mut splat.sh[coeff_ix][channel],
        } += nudge;
        splat
    }
}

impl View {
    /// This view with the camera moved by a small motion `exp(pose) * camera_from_world`.
    pub(crate) fn moved(&self, pose: &[f64; 6]) -> Self {
        let [x, y, z, a, b, c] = *pose;
        let motion = Transform::new(Vector3::new(x, y, z), Vector3::new(a, b, c));
        Self {
            camera_from_world: motion * self.camera_from_world,
            ..self.clone()
        }
    }
}
