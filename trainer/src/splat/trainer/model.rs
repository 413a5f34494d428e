//! The optimized state, which consists of splats and camera parameters. Grows the splat count up to
//! a limit.

use super::recorder::Recorder;
use super::renderer::Renderer;
use crate::Error;
use crate::model_options::ModelOptions;
use crate::splat::buffers::{SplatBuffers, n_sh_rest};
use crate::splat::camera_params::CameraParams;
use crate::splat::kernels::TrainPipelines;
use crate::splat::options::SplatOptions;
use crate::splat::params::{Gathering, Growth, MIN_OPACITY};
use crate::splat::passes::{self, GrowthBuffers};
use gpu::Gpu;
use model_files::splat::arrays::SplatArrays;

/// Standard deviation of a child's offset from its parent, in standard deviations of the parent.
/// 3DGS-MCMC places children at the parent's mean. With a larger spread, a family no longer renders
/// as its parent did. With a smaller spread, the members of the family take longer to separate.
const CHILD_SPREAD: f32 = 0.5;

/// Fractions of the limit: the smallest and the largest number of splats that are removed at once.
/// With a smaller number, the model would be copied for every new image. With a larger one, a few
/// new images would replace most of the model.
const REMOVED_FRACS: [f64; 2] = [1.0 / 16.0, 1.0 / 4.0];

/// Splats and camera parameters in training.
#[derive(Debug)]
pub(super) struct TrainedModel {
    pub(super) splats: SplatBuffers,
    pub(super) cameras: CameraParams,
    max_splats: u32,
    /// Whether the GPU has no memory left for more splats.
    is_full: bool,
    /// Whether the memory was large enough for a copy of the model, whenever one was made.
    has_room_for_copy: bool,
    /// Whether only new images add splats, because larger models would be too slow.
    pub(super) is_growth_paused: bool,
}

impl TrainedModel {
    /// A model without splats.
    pub(super) fn new(gpu: &Gpu, options: &ModelOptions<SplatOptions>) -> Result<Self, Error> {
        Ok(Self {
            splats: SplatBuffers::new(gpu, 1, options.specific.sh_degree)?,
            cameras: CameraParams::new(gpu, options.common.cameras.always())?,
            max_splats: options.cap(),
            is_full: false,
            has_room_for_copy: true,
            is_growth_paused: false,
        })
    }

    /// Adds splats, up to the limit.
    pub(super) fn add(
        &mut self,
        recorder: &mut Recorder,
        renderer: &mut Renderer,
        arrays: &SplatArrays,
    ) -> Result<(), Error> {
        let n_before = self.splats.n_splats;
        let n_allowed = self.max_splats.saturating_sub(n_before) as usize;
        let n_after = n_before + n_splats_u32(arrays.n_splats().min(n_allowed));
        if n_after == n_before {
            return Ok(());
        }
        let n_new = (self.reserve_up_to(recorder, renderer, n_after)? - n_before) as usize;
        if n_new == 0 {
            return Ok(());
        }
        // If the limit is exceeded, a coarser sample of all areas is better than a complete sample
        // of a few areas.
        let kept = if n_new == arrays.n_splats() {
            arrays.clone()
        } else {
            spread_out(arrays, n_new)
        };
        self.splats.append(&recorder.gpu, &kept);
        Ok(())
    }

    /// Replaces dead splats with children of other splats, then adds up to `n_more` children,
    /// within the limit. `key` seeds the random choices.
    pub(super) fn grow(
        &mut self,
        recorder: &mut Recorder,
        renderer: &mut Renderer,
        learn: &TrainPipelines,
        n_more: u32,
        key: u32,
    ) -> Result<(), Error> {
        // Dead splats are replaced even if none may be added.
        let n_before = self.splats.n_splats;
        let n_more = if self.is_full || self.is_growth_paused {
            0
        } else {
            n_more
        };
        // Growth never removes splats, even if their number is above the limit.
        let n_after = n_before
            .saturating_add(n_more)
            .min(self.max_splats)
            .max(n_before);
        let n_after = self
            .reserve_up_to(recorder, renderer, n_after)?
            .max(n_before);
        let growth = Growth {
            n_before,
            n_after,
            key,
            capacity: self.splats.capacity,
            n_sh_rest: n_sh_rest(self.splats.sh_degree),
            child_spread: CHILD_SPREAD,
            min_opacity: MIN_OPACITY,
            unused: 0.0,
        };
        // Without memory for the temporary buffers, training continues with the current splats.
        let buffers = match GrowthBuffers::new(&recorder.gpu, &growth) {
            Err(error) if error.is_out_of_memory() => {
                self.stop_growing(&error);
                return Ok(());
            }
            buffers => buffers?,
        };
        passes::grow(
            &recorder.gpu,
            &mut recorder.passes,
            learn,
            &self.splats,
            &buffers,
            &growth,
        );
        recorder.submit_and_release_buffers();
        self.splats.set_n_splats(&recorder.gpu, n_after);
        Ok(())
    }

    /// Reserves capacity for `n_splats`. Returns this number, or a smaller number if GPU memory is
    /// insufficient.
    fn reserve_up_to(
        &mut self,
        recorder: &mut Recorder,
        renderer: &mut Renderer,
        n_splats: u32,
    ) -> Result<u32, Error> {
        if self.is_full {
            return Ok(n_splats.min(self.splats.capacity));
        }
        match self.reserve(recorder, renderer, n_splats) {
            Ok(()) => Ok(n_splats),
            // Without any splats, there is no model to continue with.
            Err(error) if error.is_out_of_memory() && self.splats.n_splats > 0 => {
                self.stop_growing(&error);
                Ok(n_splats.min(self.splats.capacity))
            }
            Err(error) => Err(error),
        }
    }

    fn reserve(
        &mut self,
        recorder: &mut Recorder,
        renderer: &mut Renderer,
        n_splats: u32,
    ) -> Result<(), Error> {
        let have = self.splats.capacity;
        if n_splats <= have {
            return Ok(());
        }
        // The capacity grows by at least half. A model that grows by a tenth at a time is thus
        // copied only every few changes.
        let capacity = n_splats
            .max(have.saturating_mul(3) / 2)
            .min(self.max_splats.max(n_splats));
        // The drawing buffers are reserved first, so that every model that fits into memory can
        // also be drawn.
        renderer.reserve_splats(recorder, capacity)?;
        self.splats = self
            .splats
            .resized(&recorder.gpu, capacity, self.splats.sh_degree)?;
        recorder.passes.clear_bindings();
        Ok(())
    }

    /// Number of splats to remove before `n_new` splats are added; 0 if the limit is not exceeded.
    pub(super) fn n_to_remove(&self, n_new: u32) -> u32 {
        let (n_splats, limit) = (self.splats.n_splats, self.limit());
        let n_excess = n_splats.saturating_add(n_new).saturating_sub(limit);
        if n_excess == 0 || !self.has_room_for_copy {
            return 0;
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a fraction of a u32"
        )]
        let [smallest, largest] = REMOVED_FRACS.map(|frac| (frac * f64::from(limit)) as u32);
        n_excess.clamp(smallest, largest).min(n_splats / 2)
    }

    /// Removes the splats with the lowest opacity. Without memory for a copy of the model, it keeps
    /// its splats.
    pub(super) fn remove_faintest(
        &mut self,
        recorder: &mut Recorder,
        learn: &TrainPipelines,
        n_removed: u32,
    ) -> Result<(), Error> {
        let n_splats = self.splats.n_splats;
        let shapes: Vec<[f32; 4]> = recorder.gpu.read(&self.splats.shapes, n_splats as usize)?;
        let mut by_opacity: Vec<u32> = (0..n_splats).collect();
        by_opacity.select_nth_unstable_by(n_removed as usize, |a, b| {
            let opacity = |ix: &u32| shapes[*ix as usize][3];
            opacity(a).total_cmp(&opacity(b)).then(a.cmp(b))
        });
        let mut kept = by_opacity.split_off(n_removed as usize);
        kept.sort_unstable();
        match self.keep(recorder, learn, &kept, self.splats.capacity) {
            Err(error) if error.is_out_of_memory() => {
                self.has_room_for_copy = false;
                self.stop_growing(&error);
                Ok(())
            }
            kept => kept,
        }
    }

    /// Keeps the splats with these indices, in increasing order. `capacity`: number of splats for
    /// which there is memory.
    pub(super) fn keep(
        &mut self,
        recorder: &mut Recorder,
        learn: &TrainPipelines,
        kept: &[u32],
        capacity: u32,
    ) -> Result<(), Error> {
        self.splats = gather_splats(recorder, &self.splats, learn, kept, capacity)?;
        recorder.passes.clear_bindings();
        Ok(())
    }

    /// Maximum number of splats.
    pub(super) fn limit(&self) -> u32 {
        if self.is_full {
            self.splats.capacity.min(self.max_splats)
        } else {
            self.max_splats
        }
    }

    /// Whether GPU memory is too small for more splats.
    pub(super) fn is_full(&self) -> bool {
        self.is_full
    }

    /// Restores the result of [`Self::is_full`].
    pub(super) fn set_full(&mut self, is_full: bool) {
        self.is_full = is_full;
    }

    /// Keeps the number of splats from now on, because GPU memory is too small.
    pub(super) fn stop_growing(&mut self, error: &Error) {
        if !std::mem::replace(&mut self.is_full, true) {
            log::warn!(
                "the model stops growing at {} splats: {error}",
                self.splats.n_splats
            );
        }
    }
}

/// Copies the splats with the given indices, including their moments.
fn gather_splats(
    recorder: &mut Recorder,
    splats: &SplatBuffers,
    learn: &TrainPipelines,
    kept: &[u32],
    capacity: u32,
) -> Result<SplatBuffers, Error> {
    let Recorder { gpu, passes } = recorder;
    let n_kept = u32::try_from(kept.len()).expect("at most the number of splats, which is a u32");
    let mut fewer = SplatBuffers::new(gpu, capacity, splats.sh_degree)?;
    let indices = gpu.storage_with("splat.kept", bytemuck::cast_slice(kept))?;
    // One kernel copies all buffers, because it treats each entry as a number of words. Planes of
    // one buffer are as far apart as the capacity, which differs between the two models.
    for ((from, n_planes, bytes), (to, _, _)) in splats.planes().iter().zip(fewer.planes()) {
        let words = u32::try_from(bytes / 4).expect("an entry has a few words");
        let gathering = Gathering {
            n_kept,
            n_planes: *n_planes,
            words,
            from_capacity: splats.capacity,
            to_capacity: fewer.capacity,
        };
        let buffers = [
            (
                "gathering",
                &gpu.uniform_with("splat.gathering", &gathering),
            ),
            ("kept", &indices),
            ("from_words", *from),
            ("to_words", to),
        ];
        let n_words = u64::from(n_kept) * u64::from(words) * u64::from(*n_planes);
        passes.dispatch(gpu, &learn.gather, n_words.div_ceil(256), &buffers);
    }
    passes.submit(gpu);
    fewer.set_active_degree(gpu, splats.active_degree());
    fewer.set_n_splats(gpu, n_kept);
    Ok(fewer)
}

/// Picks `n` splats at even intervals of the list.
fn spread_out(arrays: &SplatArrays, n: usize) -> SplatArrays {
    let picks: Vec<usize> = (0..n).map(|ix| ix * arrays.n_splats() / n).collect();
    let n_coeffs = arrays.n_coefficients();
    SplatArrays {
        means: picks.iter().map(|ix| arrays.means[*ix]).collect(),
        log_scales: picks.iter().map(|ix| arrays.log_scales[*ix]).collect(),
        rotations_wxyz: picks.iter().map(|ix| arrays.rotations_wxyz[*ix]).collect(),
        opacity_logits: picks.iter().map(|ix| arrays.opacity_logits[*ix]).collect(),
        sh: picks
            .iter()
            .flat_map(|ix| {
                arrays.sh[ix * n_coeffs..(ix + 1) * n_coeffs]
                    .iter()
                    .copied()
            })
            .collect(),
        sh_degree: arrays.sh_degree,
        is_antialiased: arrays.is_antialiased,
    }
}

pub(super) fn n_splats_u32(n: usize) -> u32 {
    u32::try_from(n).expect("at most the limit, which is a u32")
}
