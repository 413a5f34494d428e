//! The passes, buffers and counters of training steps.

use super::lazy_pipelines::LazyPipelines;
use super::model::TrainedModel;
use super::recorder::Recorder;
use super::renderer::{self, Renderer};
use crate::Error;
use crate::model_options::ModelOptions;
use crate::splat::buffers::ImageBuffers;
use crate::splat::few_images::Scarcity;
use crate::splat::kernels::TrainPipelines;
use crate::splat::options::SplatOptions;
use crate::splat::params::{Rule, Supervision, status};
use crate::splat::passes::{Target, ViewPasses};
use crate::splat::views::Level;
use gpu::{Buffer, Gpu, Passes, PendingRead, Submits};

/// Updates the model to match the training images.
#[derive(Debug)]
pub(super) struct Optimizer {
    pub(super) pipelines: LazyPipelines,
    pub(super) submits: Submits,
    pub(super) image_buffers: Option<ImageBuffers>,
    /// Counters of the training passes.
    pub(super) status: Buffer,
    rule: Buffer,
    supervision: Buffer,
    /// Whether D-SSIM is part of the loss.
    has_ssim: bool,
    /// Number of gradients dropped because they were not finite.
    pub(super) n_non_finite: u64,
}

/// Resources of a step that the optimizer does not own.
#[derive(Clone, Copy)]
pub(super) struct StepContext<'a> {
    pub(super) gpu: &'a Gpu,
    pub(super) learn: &'a TrainPipelines,
    pub(super) renderer: &'a Renderer,
    pub(super) model: &'a TrainedModel,
}

/// The resources of one training step.
pub(super) struct PreparedView<'a> {
    pub(super) view: ViewPasses<'a>,
    level: &'a Level,
    /// Present if camera parameters are optimized.
    lens: Option<&'a Buffer>,
}

impl Optimizer {
    pub(super) fn new(
        gpu: &Gpu,
        options: &ModelOptions<SplatOptions>,
        pipelines: LazyPipelines,
    ) -> Result<Self, Error> {
        Ok(Self {
            pipelines,
            submits: Submits::default(),
            image_buffers: None,
            status: gpu.storage_with("splat.train_status", &[0; 4 * status::LEN])?,
            rule: gpu.uniform_with("splat.rule", &<Rule as bytemuck::Zeroable>::zeroed()),
            supervision: gpu.uniform_with(
                "splat.supervision",
                &<Supervision as bytemuck::Zeroable>::zeroed(),
            ),
            // If the loss has no D-SSIM, its passes would take time without any effect.
            has_ssim: options.specific.dssim_frac > 0.0,
            n_non_finite: 0,
        })
    }

    /// Uploads the learning rates of the next steps.
    pub(super) fn write_rule(&self, gpu: &Gpu, rule: &Rule) {
        gpu.write(&self.rule, 0, bytemuck::bytes_of(rule));
    }

    /// Uploads the loss weights of the next steps.
    pub(super) fn write_supervision(
        &self,
        gpu: &Gpu,
        options: &SplatOptions,
        scarcity: Scarcity,
        mean_srgb: [f32; 3],
    ) {
        let supervision = scarcity.supervision(options, mean_srgb);
        gpu.write(&self.supervision, 0, bytemuck::bytes_of(&supervision));
    }

    /// Sets the fraction of the splats that the next steps leave out.
    pub(super) fn write_drop_frac(&self, gpu: &Gpu, drop_frac: f32) {
        self.write_counter(gpu, status::DROP_FRAC, drop_frac.to_bits());
    }

    /// Sets the number of splats for the next passes.
    pub(super) fn set_n_splats(&self, gpu: &Gpu, n_splats: u32) {
        renderer::write_n_splats(gpu, &self.status, n_splats);
    }

    /// Sets one counter on the GPU.
    pub(super) fn write_counter(&self, gpu: &Gpu, counter: usize, value: u32) {
        gpu.write(&self.status, 4 * counter as u64, &value.to_le_bytes());
    }

    /// Clears the failure flag of a submit.
    pub(super) fn clear_failure(&self, gpu: &Gpu) {
        renderer::clear_failure(gpu, &self.status);
    }

    /// Buffers of the picture of the latest step.
    pub(super) fn image_buffers(&self) -> Result<&ImageBuffers, Error> {
        self.image_buffers
            .as_ref()
            .ok_or_else(|| Error::internal("no image buffers are reserved for a step"))
    }

    /// Sets the error of every pixel to one and its other gradients to zero. The error sum of a
    /// splat then equals the sum of its blending weights.
    pub(super) fn set_unit_errors(&self, recorder: &mut Recorder) {
        if let Some(image_buffers) = &self.image_buffers {
            recorder.gpu.write(
                &image_buffers.pixel_totals,
                0,
                bytemuck::cast_slice(&[0.0f32, 1.0].repeat(image_buffers.n_pixels as usize)),
            );
            recorder.passes.clear(&image_buffers.upstream);
        }
    }

    /// Allocates the buffers for training up to `capacity` splats on images of this size.
    pub(super) fn reserve_view(
        &mut self,
        recorder: &mut Recorder,
        renderer: &mut Renderer,
        capacity: u32,
        size_px: [u32; 2],
    ) -> Result<(), Error> {
        renderer.reserve_view(recorder, capacity, size_px, true)?;
        renderer::reserve_image(recorder, &mut self.image_buffers, size_px, true)
    }

    /// Records the passes of one step on a view. Requires a previous [`Self::reserve_view`].
    pub(super) fn record_step(
        &self,
        context: &StepContext<'_>,
        passes: &mut Passes,
        view: (Option<&Buffer>, &Level),
    ) -> Result<(), Error> {
        let StepContext {
            gpu,
            learn,
            renderer,
            model,
        } = *context;
        let PreparedView { view, level, lens } = self.prepared_view(context, passes, view)?;
        let target = Target {
            image: &level.image,
            depth: &level.depth,
            supervision: &self.supervision,
            gains: &model.cameras.gains,
            ssim: self.has_ssim,
        };
        view.draw_for_backward(passes, &renderer.pipelines, learn);
        view.compare(passes, learn, &target);
        view.backward(passes, learn);
        // The gradients with respect to the camera are sums over all splats. Only one of the two
        // variants of the kernel writes these sums.
        if let Some(lens) = lens {
            view.update(passes, &learn.update_with_camera, &self.rule, true);
            model.cameras.refine(&view, passes, learn, lens);
        } else {
            view.update(passes, &learn.update, &self.rule, false);
        }
        // This is the last pass of the step, because the others read the step counter.
        passes.dispatch(gpu, &learn.advance, 1, &[("status", &self.status)]);
        Ok(())
    }

    /// Returns a view with the current camera parameters applied, and records the pass that applies
    /// them.
    pub(super) fn prepared_view<'a>(
        &'a self,
        context: &StepContext<'a>,
        passes: &mut Passes,
        (lens, level): (Option<&'a Buffer>, &'a Level),
    ) -> Result<PreparedView<'a>, Error> {
        let StepContext {
            gpu,
            learn,
            renderer,
            model,
        } = *context;
        // After a rejected trial of camera parameters, there are slots that are not optimized.
        let lens = lens.filter(|_| !model.cameras.set.is_empty());
        if let Some(lens) = lens {
            model.cameras.correct(gpu, passes, learn, &level.view, lens);
        }
        let view = ViewPasses {
            gpu,
            splats: &model.splats,
            scratch: renderer.scratch()?,
            image_buffers: self
                .image_buffers
                .as_ref()
                .ok_or_else(|| Error::internal("no image buffers are reserved for a step"))?,
            status: &self.status,
            view: if lens.is_some() {
                &model.cameras.corrected
            } else {
                &level.view
            },
            size_px: level.size_px,
            // Edits never affect training.
            clipping: None,
        };
        Ok(PreparedView { view, level, lens })
    }

    /// Submits the recorded steps and starts reading back the counters.
    pub(super) fn submit(&self, recorder: &mut Recorder) -> PendingRead {
        recorder
            .passes
            .submit_reading(&recorder.gpu, &[(&self.status, 4 * status::LEN)])
    }

    /// Stores the number of non-finite gradients. Logs a warning when it becomes nonzero and at
    /// each doubling.
    pub(super) fn log_non_finite(&mut self, n_non_finite: u64) {
        // The logarithm of 0 is `None`, which is less than any number.
        if n_non_finite.checked_ilog2() > self.n_non_finite.checked_ilog2() {
            log::warn!("dropped {n_non_finite} non-finite gradients of splats so far");
        }
        self.n_non_finite = n_non_finite;
    }
}
