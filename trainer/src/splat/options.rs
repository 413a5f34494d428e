//! How a splat model learns.

use super::trials::{CameraRefinement, CountPolicy};
use serde::{Deserialize, Serialize};

/// Settings of a [`super::SplatTrainer`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplatOptions {
    /// Seeds every random choice.
    pub seed: u64,
    /// Most splats the model may have.
    pub max_splats: u32,
    /// How many it takes.
    pub count: CountPolicy,
    /// Most bytes of GPU memory the model (parameters and the optimiser's moments) may take.
    pub max_bytes: Option<u64>,
    /// Highest degree of spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Steps over which learning rates fall and the model grows.
    pub n_planned_steps: u64,
    /// Share of D-SSIM in the color loss.
    pub dssim_frac: f64,
    /// Weight of the depth loss, per metre.
    pub depth_per_m: f64,
    /// How bright the background may be that changes every step: enough to keep black things solid. Up to 1 costs 1 dB
    /// in the first few hundred steps, while much is still bare.
    pub random_background: f64,
    /// Opacity and size cost the square of this over the number of images, against the color loss: the fewer images there
    /// are, the more must speak for a splat. 0: they cost nothing.
    pub cost_images: f64,
    /// Growth at each change of the splat count, as a share of it.
    pub growth_frac: f64,
    /// How far places wander at random, against their learning rate: the fainter a splat, the further.
    pub noise: f64,
    /// Steps at a quarter of the resolution, and past which step the full one is used; `None`: few on a GPU, many on a
    /// processor, where a step takes as long as the image has pixels.
    pub coarse_steps: Option<[u64; 2]>,
    /// What is learned about cameras.
    pub cameras: CameraRefinement,
    /// What is found about cameras by laying keyframes with depth over each other, before it is learned from the splats.
    #[serde(default)]
    pub align: CameraRefinement,
    /// Splats that one depth image may add; `None`: fewer on a processor.
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
    /// Bytes of one splat: parameters, Adam's moments (one for all colors past the constant) and the sum of errors.
    pub fn bytes_per_splat(&self) -> u64 {
        let n_floats = 12 + 3; // Means, rotations and shapes are padded to 4 each.
        4 * (3 * n_floats + u64::from(super::buffers::n_sh_rest(self.sh_degree)) + 1 + 1)
    }

    /// Most splats that both caps allow.
    pub(crate) fn cap(&self) -> u32 {
        let by_bytes = self.max_bytes.map_or(u64::MAX, |bytes| bytes / self.bytes_per_splat());
        self.max_splats.min(u32::try_from(by_bytes).unwrap_or(u32::MAX)).max(1)
    }
}
