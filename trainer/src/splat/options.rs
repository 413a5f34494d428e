//! Options of the splat model.

use super::trials::CountPolicy;
use calibration::CameraRefinement;
use serde::{Deserialize, Serialize};

/// Settings of a [`super::SplatTrainer`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplatOptions {
    /// Seeds every random choice.
    pub seed: u64,
    /// Maximum number of splats.
    pub max_splats: u32,
    /// How the number of splats is chosen.
    pub count: CountPolicy,
    /// Maximum GPU memory of the model (parameters and the optimizer's moments), bytes.
    pub max_bytes: Option<u64>,
    /// Highest degree of spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Steps over which learning rates decay and the model grows.
    pub n_planned_steps: u64,
    /// Weight of D-SSIM in the color loss, 0 to 1.
    pub dssim_frac: f64,
    /// Weight of the depth loss, per meter.
    pub depth_per_m: f64,
    /// Maximum brightness of the random background, which changes at every step and keeps dark objects opaque. A
    /// value of 1 costs 1 dB in the first few hundred steps, while large parts of the image are uncovered.
    pub random_background: f64,
    /// The costs of opacity and size relative to the color loss are `(cost_images / n_images)^2`: with fewer images,
    /// more evidence is needed for a splat. 0 disables the costs.
    pub cost_images: f64,
    /// Growth at each change of the splat count, as a fraction of the count.
    pub growth_frac: f64,
    /// Scale of the random motion of means relative to their learning rate; the more transparent a splat, the further
    /// it moves.
    pub noise: f64,
    /// Number of steps at a quarter of the resolution, and step from which the full resolution is used. `None`
    /// selects few coarse steps on a GPU and many on a CPU, where the time of a step is proportional to the number of
    /// pixels.
    pub coarse_steps: Option<[u64; 2]>,
    /// Camera parameters that are optimized with the splats.
    pub cameras: CameraRefinement,
    /// Camera parameters that are estimated by registering keyframes with depth, before the model is trained on them;
    /// see [`crate::Aligned`].
    #[serde(default)]
    pub align: CameraRefinement,
    /// Maximum number of splats added for one depth image; `None` selects fewer on a CPU.
    pub seeds_per_image: Option<f64>,
}

impl Default for SplatOptions {
    fn default() -> Self {
        Self {
            seed: 0,
            max_splats: 400_000,
            count: CountPolicy::default(),
            max_bytes: None,
            sh_degree: 3,
            n_planned_steps: 7000,
            dssim_frac: 0.2,
            depth_per_m: 0.1,
            random_background: 0.25,
            cost_images: 13.0,
            growth_frac: 0.1,
            noise: 5e5,
            coarse_steps: None,
            cameras: CameraRefinement::default(),
            align: CameraRefinement::default(),
            seeds_per_image: None,
        }
    }
}

impl SplatOptions {
    /// Bytes per splat: parameters, Adam's moments (one for all colors past the constant) and the error sum.
    pub fn bytes_per_splat(&self) -> u64 {
        let n_floats = 12 + 3; // Means, rotations and shapes are padded to 4 each.
        4 * (3 * n_floats + u64::from(super::buffers::n_sh_rest(self.sh_degree)) + 1 + 1)
    }

    /// Maximum number of splats allowed by both limits.
    pub(crate) fn cap(&self) -> u32 {
        let by_bytes = self.max_bytes.map_or(u64::MAX, |bytes| bytes / self.bytes_per_splat());
        self.max_splats.min(u32::try_from(by_bytes).unwrap_or(u32::MAX)).max(1)
    }
}
