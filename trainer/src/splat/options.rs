//! Options of the splat model.

use super::trial_steps::TrialSteps;
use super::trials::CountPolicy;
use crate::model_options::{MethodOptions, ModelOptions};
use serde::{Deserialize, Serialize};

/// Options of a [`super::SplatTrainer`], besides the options that all methods share.
///
/// Checkpoints store these options. Older checkpoints must remain readable. A new field therefore
/// needs `#[serde(default)]`, or `default = ..` with the value that training used before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplatOptions {
    /// Maximum number of splats.
    pub max_splats: u32,
    /// How the number of splats is chosen.
    pub count: CountPolicy,
    /// Highest degree of spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Weight of D-SSIM in the color loss, 0 to 1.
    pub dssim_frac: f64,
    /// Weight of the depth loss, per meter.
    pub depth_per_m: f64,
    /// Maximum brightness of the background. It is random in every step, which keeps dark objects
    /// opaque. With a value of 1, scores are 1 dB lower in the first few hundred steps, while large
    /// parts of the image are uncovered.
    pub random_background: f64,
    /// Determines the costs of opacity and size. Relative to the color loss, they are `(cost_images
    /// / n_images)^2`. The fewer images there are, the more each splat must reduce the color loss
    /// to persist. 0 disables the costs.
    pub cost_images: f64,
    /// Growth at each change of the splat count, as a fraction of the count.
    pub growth_frac: f64,
    /// Scale of the noise added to the means, relative to their learning rate. The noise is largest
    /// for transparent splats.
    pub noise: f64,
    /// Maximum fraction of the splats that a step leaves out at random. The fraction reaches this
    /// maximum if there are few images, and it is zero if there are many.
    pub drop_frac: f64,
    /// Steps at which training switches from a quarter to half of the resolution, and from half to
    /// the full resolution. `None` selects a default for the adapter. The default is higher on a
    /// CPU, where the duration of a step is proportional to the number of pixels.
    pub coarse_steps: Option<[u64; 2]>,
    /// Maximum number of pixels of an image during the first and the second of the coarse stages. It
    /// replaces the quarter and the half of the resolution: an image is reduced until its size is
    /// within the limit, and a smaller image is not reduced. `u32::MAX` is no limit. `None` selects
    /// a default: a limit on a CPU, and none on a GPU.
    #[serde(default = "without_limit")]
    pub max_coarse_px: Option<[u32; 2]>,
    /// Number of splats at random positions from which training starts if there is no depth. `None`
    /// selects a default, which is lower on a CPU.
    #[serde(default = "former_random_splats")]
    pub random_splats: Option<u32>,
    /// Maximum number of splats added for one depth image. `None` selects a default, which is lower
    /// on a CPU.
    pub seeds_per_image: Option<f64>,
    /// When parts of the model are tested.
    #[serde(default)]
    pub trial_steps: TrialSteps,
}

/// Images of any size, in both coarse stages.
pub(super) const ANY_SIZE_PX: [u32; 2] = [u32::MAX; 2];
/// Number of splats at random positions on a GPU, about as many as the discs of the first keyframes
/// with depth.
pub(super) const RANDOM_SPLATS: u32 = 50_000;

/// The limit of checkpoints that store none.
fn without_limit() -> Option<[u32; 2]> {
    Some(ANY_SIZE_PX)
}

/// The number of checkpoints that store none.
fn former_random_splats() -> Option<u32> {
    Some(RANDOM_SPLATS)
}

impl MethodOptions for SplatOptions {
    const METHOD: &'static str = "splat";
}

impl Default for SplatOptions {
    fn default() -> Self {
        Self {
            max_splats: 400_000,
            count: CountPolicy::default(),
            // This value and the weight of D-SSIM are from Kerbl et al. 2023.
            sh_degree: 3,
            dssim_frac: 0.2,
            depth_per_m: 0.1,
            random_background: 0.25,
            // The value was chosen from 0, 6, 13 and 20 by the scores of three data sets
            // (docs/benchmarks/2026-11-23-splats.md, section "Ablation").
            cost_images: 13.0,
            // This is twice the growth fraction of 3DGS-MCMC.
            growth_frac: 0.1,
            // This is the value of 3DGS-MCMC.
            noise: 5e5,
            // With 6 and 11 images, 10 % gained less
            // (docs/benchmarks/2026-11-25-few-images.md, section "Single changes").
            drop_frac: 0.2,
            coarse_steps: None,
            max_coarse_px: None,
            random_splats: None,
            seeds_per_image: None,
            trial_steps: TrialSteps::default(),
        }
    }
}

impl SplatOptions {
    /// Bytes per splat for parameters, Adam's moments and the error sum. The higher SH coefficients
    /// share one moment.
    pub fn bytes_per_splat(&self) -> u64 {
        // Means, rotations and shapes are padded to 4 each, and the constant color has 3. Each has
        // two moments. The last two words are the shared moment and the error sum.
        let n_floats = 12 + 3;
        4 * (3 * n_floats + u64::from(super::buffers::n_sh_rest(self.sh_degree)) + 1 + 1)
    }
}

impl ModelOptions<SplatOptions> {
    /// Maximum number of splats that satisfies both the limit on splats and the limit on bytes.
    pub(crate) fn cap(&self) -> u32 {
        let by_bytes = self
            .common
            .max_bytes
            .map_or(u64::MAX, |bytes| bytes / self.specific.bytes_per_splat());
        // The result is at least one splat, because buffers cannot be empty.
        self.specific
            .max_splats
            .min(u32::try_from(by_bytes).unwrap_or(u32::MAX))
            .max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::SplatOptions;

    /// The options that every checkpoint contains. Do not add new options.
    const REQUIRED: [&str; 12] = [
        "max_splats",
        "count",
        "sh_degree",
        "dssim_frac",
        "depth_per_m",
        "random_background",
        "cost_images",
        "growth_frac",
        "noise",
        "drop_frac",
        "coarse_steps",
        "seeds_per_image",
    ];

    #[test]
    fn options_of_older_checkpoints_can_be_read() {
        let mut options = serde_json::to_value(SplatOptions::default()).expect("plain data");
        options
            .as_object_mut()
            .expect("an object")
            .retain(|name, _| REQUIRED.contains(&name.as_str()));
        let read: SplatOptions =
            serde_json::from_value(options).expect("newer options have defaults");
        // Training continues in the way in which it began.
        let former = SplatOptions {
            max_coarse_px: Some([u32::MAX; 2]),
            random_splats: Some(50_000),
            ..SplatOptions::default()
        };
        assert_eq!(read, former);
    }
}
