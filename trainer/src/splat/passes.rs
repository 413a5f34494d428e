//! The stages of drawing and training, as lists of passes.

use super::buffers::{
    BLOCK, GROUP, ImageBuffers, Scratch, SplatBuffers, WINDOW_BINS, n_bins, n_tiles,
};
use super::clipping::Clipping;
use super::kernels::{DrawPipelines, Ssim, TrainPipelines};
use super::params::{Growth, TILE_PX};
use crate::Error;
use gpu::{Buffer, Gpu, Passes, Pipeline};

/// Buffers that the passes of one view use.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ViewPasses<'a> {
    pub(crate) gpu: &'a Gpu,
    pub(crate) splats: &'a SplatBuffers,
    pub(crate) scratch: &'a Scratch,
    pub(crate) image_buffers: &'a ImageBuffers,
    pub(crate) status: &'a Buffer,
    pub(crate) view: &'a Buffer,
    pub(crate) size_px: [u32; 2],
    /// `None` in training, and if there is neither a crop box nor erased space.
    pub(crate) clipping: Option<Clipping<'a>>,
}

/// The target that a picture is compared with.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Target<'a> {
    pub(crate) image: &'a Buffer,
    pub(crate) depth: &'a Buffer,
    pub(crate) supervision: &'a Buffer,
    /// Gains applied to the picture's red, green and blue before the comparison.
    pub(crate) gains: &'a Buffer,
    /// Whether D-SSIM is part of the loss.
    pub(crate) ssim: bool,
}

/// Buffers of one change of the splat count.
#[derive(Debug)]
pub(crate) struct GrowthBuffers {
    pub(crate) growth: Buffer,
    pub(crate) weights: Buffer,
    pub(crate) cumulative: Buffer,
    pub(crate) block_weights: Buffer,
    pub(crate) n_children: Buffer,
    pub(crate) parents: Buffer,
}

impl GrowthBuffers {
    /// Allocates the buffers of a change.
    pub(crate) fn new(gpu: &Gpu, growth: &Growth) -> Result<Self, Error> {
        let words = |name: &str, n: u32| gpu.storage(name, 4 * u64::from(n));
        Ok(Self {
            growth: gpu.uniform_with("splat.growth", growth),
            weights: words("splat.weights", growth.n_before)?,
            cumulative: words("splat.cumulative", growth.n_before)?,
            block_weights: words("splat.block_weights", growth.n_before.div_ceil(256))?,
            n_children: words("splat.n_children", growth.n_before)?,
            parents: words("splat.parents", growth.n_after)?,
        })
    }
}

/// Replaces dead splats with children of other splats and appends children up to `n_after`. The
/// probability of a parent is proportional to its error.
pub(crate) fn grow(
    gpu: &Gpu,
    passes: &mut Passes,
    pipelines: &TrainPipelines,
    splats: &SplatBuffers,
    buffers: &GrowthBuffers,
    growth: &Growth,
) {
    let blocks = |n: u32| u64::from(n.div_ceil(256));
    let uniform = ("growth", &buffers.growth);
    let weights = ("weights", &buffers.weights);
    let block_weights = ("block_weights", &buffers.block_weights);
    passes.clear(&buffers.n_children);
    // These passes compute cumulative errors within blocks of 256 splats and over the blocks.
    // Parents are sampled from them by binary search.
    passes.dispatch(
        gpu,
        &pipelines.grow_weigh,
        blocks(growth.n_before),
        &[
            uniform,
            ("means", &splats.means),
            ("shapes", &splats.shapes),
            ("error_sums", &splats.error_sums),
            weights,
            ("cumulative", &buffers.cumulative),
            block_weights,
        ],
    );
    passes.dispatch(gpu, &pipelines.grow_scan, 1, &[uniform, block_weights]);
    // Every child chooses its parent and increments the parent's number of children.
    passes.dispatch(
        gpu,
        &pipelines.grow_child,
        blocks(growth.n_after),
        &[
            &[
                uniform,
                weights,
                ("cumulative", &buffers.cumulative),
                block_weights,
                ("n_children", &buffers.n_children),
                ("parents", &buffers.parents),
            ][..],
            &splats.parameters(),
            &splats.all_moments(),
        ]
        .concat(),
    );
    // Opacity and scale depend on the size of the family, so they are computed after all children
    // are counted.
    passes.dispatch(
        gpu,
        &pipelines.grow_family,
        blocks(growth.n_after),
        &[
            uniform,
            ("n_children", &buffers.n_children),
            ("parents", &buffers.parents),
            ("shapes", &splats.shapes),
            ("moments", &splats.moments),
            ("error_sums", &splats.error_sums),
        ],
    );
}

/// Number of workgroups of the kernels that import `rows_and_columns`. Each workgroup handles one
/// color of two vertically adjacent tiles.
fn n_color_strips(size_px: [u32; 2]) -> u64 {
    3 * u64::from(size_px[0].div_ceil(TILE_PX)) * u64::from(size_px[1].div_ceil(2 * TILE_PX))
}

impl ViewPasses<'_> {
    /// Projects, sorts, bins and rasterizes the splats. Needs no memory for gradients.
    pub(crate) fn draw(&self, passes: &mut Passes, pipelines: &DrawPipelines) {
        self.list(passes, pipelines, &self.scratch.capacity_for_drawing);
        let mut buffers = self.rasterized();
        let rasterize = match &self.clipping {
            Some(clipping) => {
                buffers.extend(clipping.buffers());
                &clipping.pipelines.rasterize
            }
            None => &pipelines.rasterize,
        };
        passes.dispatch(
            self.gpu,
            rasterize,
            u64::from(n_tiles(self.size_px)),
            &buffers,
        );
    }

    /// [`ViewPasses::draw`], followed by [`ViewPasses::backward`].
    pub(crate) fn draw_for_backward(
        &self,
        passes: &mut Passes,
        draw: &DrawPipelines,
        train: &TrainPipelines,
    ) {
        self.list(passes, draw, &self.scratch.capacity);
        let mut buffers = self.rasterized();
        // The segments are a by-product of blending. The state of a segment consists of the running
        // values at its start.
        let rasterize = match &train.rasterize_segments {
            Some(rasterize) => {
                buffers.extend(self.segments());
                rasterize
            }
            None => &draw.rasterize,
        };
        passes.dispatch(
            self.gpu,
            rasterize,
            u64::from(n_tiles(self.size_px)),
            &buffers,
        );
    }

    /// Buffers of shared/tile.wgsl, and the buffer `last`.
    fn lists(&self) -> [(&'static str, &Buffer); 7] {
        let scratch = self.scratch;
        [
            ("view", self.view),
            ("status", self.status),
            ("bin_starts", &scratch.bin_starts),
            ("tile_bits", &scratch.tile_bits),
            ("entries", &scratch.entries),
            ("projected_splats", &scratch.projected_splats),
            ("last", &self.image_buffers.last),
        ]
    }

    /// Buffers of `rasterize`.
    fn rasterized(&self) -> Vec<(&'static str, &Buffer)> {
        let ImageBuffers { image, depth, .. } = self.image_buffers;
        [&self.lists()[..], &[("image", image), ("depth", depth)]].concat()
    }

    /// Buffers of the segments of the lists.
    fn segments(&self) -> [(&'static str, &Buffer); 4] {
        [
            ("capacity", &self.scratch.capacity),
            ("segments", &self.scratch.segments),
            ("segment_counts", &self.scratch.segment_counts),
            ("segment_states", &self.scratch.segment_states),
        ]
    }

    /// Projects, sorts and bins the splats, if they fit into this capacity.
    fn list(&self, passes: &mut Passes, pipelines: &DrawPipelines, capacity: &Buffer) {
        let Self {
            gpu,
            splats,
            scratch,
            status,
            view,
            ..
        } = *self;
        let n_blocks = u64::from(splats.n_splats.div_ceil(BLOCK));
        let view = ("view", view);
        let model = ("model", &splats.model);
        let keys = ("depth_keys", &scratch.by_depth.keys[0]);
        passes.dispatch(
            gpu,
            &pipelines.project,
            n_blocks,
            &[
                &[
                    view,
                    model,
                    ("projected_splats", &scratch.projected_splats),
                    keys,
                    ("status", status),
                ][..],
                &splats.parameters(),
            ]
            .concat(),
        );
        // Clipping is a separate kernel, so that it does not slow down training and other pictures.
        if let Some(clipping) = &self.clipping {
            let [means, rotations, shapes, ..] = splats.parameters();
            let [erased, clips] = clipping.buffers();
            let projected = ("projected_splats", &scratch.projected_splats);
            passes.dispatch(
                gpu,
                &clipping.pipelines.clip,
                n_blocks,
                &[
                    view, model, means, rotations, shapes, projected, erased, keys, clips,
                ],
            );
        }
        pipelines.sort.sort(gpu, passes, &scratch.by_depth, status);
        self.bin(passes, pipelines, capacity);
    }

    /// Lists the splats of every bin in depth order, if the lists fit into this capacity.
    fn bin(&self, passes: &mut Passes, pipelines: &DrawPipelines, capacity: &Buffer) {
        let Self {
            gpu,
            splats,
            scratch,
            size_px,
            ..
        } = *self;
        let n_blocks = u64::from(splats.n_splats.div_ceil(BLOCK));
        // Workgroup memory holds the counts of a limited number of bins, so large images need
        // several workgroups per block.
        let n_windows = u64::from(n_bins(size_px).div_ceil(WINDOW_BINS));
        let view = ("view", self.view);
        let model = ("model", &splats.model);
        let status = ("status", self.status);
        let by_depth = ("by_depth", &scratch.by_depth.values[0]);
        let bin_counts = ("bin_counts", &scratch.bin_counts);
        let group_counts = ("group_counts", &scratch.group_counts);
        let bin_totals = ("bin_totals", &scratch.bin_totals);
        let bin_starts = ("bin_starts", &scratch.bin_starts);
        let block_slots = ("block_slots", &scratch.block_slots);
        let touched = ("touched", &scratch.touched);
        let slot_offsets = ("slot_offsets", &scratch.slot_offsets);
        let entries = ("entries", &scratch.entries);
        // Entries are counted first and emitted later. WebGPU guarantees no forward progress
        // between workgroups, so a single pass in which blocks wait for their predecessors could
        // hang.
        let counted = [
            view,
            model,
            ("depth_keys", &scratch.by_depth.keys[0]),
            by_depth,
            ("projected_splats", &scratch.projected_splats),
            touched,
            ("tile_counts", &scratch.tile_counts),
            slot_offsets,
            block_slots,
            bin_counts,
        ];
        passes.dispatch(gpu, &pipelines.count_bins, n_blocks * n_windows, &counted);
        // These passes turn the counts into offsets, first within groups of blocks, then over all
        // groups of a bin, and then over all bins.
        let n_groups = n_blocks.div_ceil(u64::from(GROUP));
        passes.dispatch(
            gpu,
            &pipelines.sum_bins,
            n_groups * n_windows,
            &[view, model, bin_counts, group_counts],
        );
        let scanned = [view, model, group_counts, bin_totals];
        passes.dispatch(
            gpu,
            &pipelines.scan_bins,
            u64::from(n_bins(size_px)),
            &scanned,
        );
        let allocated = [
            view,
            model,
            ("capacity", capacity),
            bin_totals,
            bin_starts,
            block_slots,
            status,
            ("segment_counts", &scratch.segment_counts),
        ];
        passes.dispatch(gpu, &pipelines.allocate, 1, &allocated);
        // The range of every block in every list is now known, so the order of its entries depends
        // only on counts.
        let emitted = [
            view,
            model,
            by_depth,
            touched,
            bin_counts,
            group_counts,
            bin_starts,
            slot_offsets,
            block_slots,
            status,
            entries,
            ("slot_begins", &scratch.slot_begins),
        ];
        passes.dispatch(gpu, &pipelines.emit, n_blocks * n_windows, &emitted);
        // The number of entries is known only on the GPU, so workgroups are dispatched for the
        // whole capacity.
        let tile_bits = ("tile_bits", &scratch.tile_bits);
        let n_groups = u64::from(scratch.n_entries.div_ceil(512));
        passes.dispatch(
            gpu,
            &pipelines.tile_bits,
            n_groups,
            &[status, entries, tile_bits],
        );
    }

    /// Packs the picture for display.
    pub(crate) fn finish(
        &self,
        passes: &mut Passes,
        pipelines: &DrawPipelines,
        supervision: &Buffer,
    ) {
        let n_pixels = self.size_px[0] * self.size_px[1];
        passes.dispatch(
            self.gpu,
            &pipelines.finish,
            u64::from(n_pixels.div_ceil(256)),
            &[
                ("view", self.view),
                ("supervision", supervision),
                ("image", &self.image_buffers.image),
                ("depth", &self.image_buffers.depth),
                ("pixels", &self.image_buffers.pixels),
                ("depths", &self.image_buffers.depths),
            ],
        );
    }

    /// Compares the picture with its target and computes the gradient with respect to every pixel.
    pub(crate) fn compare(
        &self,
        passes: &mut Passes,
        pipelines: &TrainPipelines,
        target: &Target<'_>,
    ) {
        let Self {
            gpu,
            image_buffers,
            status,
            view,
            ..
        } = *self;
        let n_groups = u64::from(n_tiles(self.size_px));
        let base = [
            ("view", view),
            ("supervision", target.supervision),
            ("status", status),
            ("image", &image_buffers.image),
            ("target_image", target.image),
            ("gains", target.gains),
        ];
        // SSIM comes before the loss, which reads the gradients of whole windows.
        if target.ssim {
            let mut buffers = base.to_vec();
            buffers.push(("ssim_gradients", &image_buffers.ssim_gradients));
            match &pipelines.ssim {
                Ssim::Tiles(ssim) => passes.dispatch(gpu, ssim, n_groups, &buffers),
                Ssim::Strips { means, upstream } => {
                    let n_groups = n_color_strips(self.size_px);
                    passes.dispatch(gpu, means, n_groups, &buffers);
                    buffers.push(("upstream", &image_buffers.upstream));
                    passes.dispatch(gpu, upstream, n_groups, &buffers);
                }
            }
        }
        let mut buffers = base.to_vec();
        buffers.extend([
            ("depth", &image_buffers.depth),
            ("target_depth", target.depth),
            ("ssim_gradients", &image_buffers.ssim_gradients),
            ("upstream", &image_buffers.upstream),
            ("pixel_totals", &image_buffers.pixel_totals),
            ("gain_sums", &image_buffers.gain_sums),
        ]);
        passes.dispatch(
            gpu,
            if target.ssim {
                &pipelines.loss
            } else {
                &pipelines.loss_without_ssim
            },
            n_groups,
            &buffers,
        );
    }

    /// Propagates the gradients from the pixels to the intersections.
    pub(crate) fn backward(&self, passes: &mut Passes, pipelines: &TrainPipelines) {
        let Self {
            gpu,
            scratch,
            image_buffers,
            ..
        } = *self;
        let n_tiles = u64::from(n_tiles(self.size_px));
        let mut buffers = self.lists().to_vec();
        buffers.extend([
            ("upstream", &image_buffers.upstream),
            ("pixel_totals", &image_buffers.pixel_totals),
            ("gradients", &scratch.gradients),
        ]);
        // Without segments, a workgroup processes the whole list of a tile.
        let mut n_groups = n_tiles;
        if pipelines.rasterize_segments.is_some() {
            buffers.extend(self.segments());
            // The workgroups process the first segment of each tile, the further segments, and the
            // pieces of hidden ends, of which there are up to two more per tile. These numbers are
            // upper bounds, because the actual numbers are known only on the GPU.
            let [n_further, n_hidden] = scratch.n_segments.map(u64::from);
            n_groups = n_tiles + n_further + n_hidden + 2 * n_tiles;
        }
        passes.dispatch(gpu, &pipelines.backward, n_groups, &buffers);
    }

    /// Adds each splat's contribution to the picture to `contributions`. Requires a previous
    /// [`ViewPasses::backward`] with an error of one at every pixel.
    pub(crate) fn contribute(
        &self,
        passes: &mut Passes,
        pipelines: &TrainPipelines,
        contributions: &Buffer,
    ) {
        let buffers = [
            ("model", &self.splats.model),
            ("status", self.status),
            ("tile_counts", &self.scratch.tile_counts),
            ("slot_begins", &self.scratch.slot_begins),
            ("gradients", &self.scratch.gradients),
            ("contributions", contributions),
        ];
        let n_blocks = self.splats.n_splats.div_ceil(BLOCK);
        passes.dispatch(self.gpu, &pipelines.contribute, n_blocks.into(), &buffers);
    }

    /// Propagates the gradients from the intersections to the parameters and takes one optimizer
    /// step. Set `camera` if the kernel `update` also sums the camera gradients.
    pub(crate) fn update(
        &self,
        passes: &mut Passes,
        update: &Pipeline,
        rule: &Buffer,
        camera: bool,
    ) {
        let Self {
            gpu,
            splats,
            scratch,
            status,
            view,
            ..
        } = *self;
        let mut buffers = vec![
            ("slot_begins", &scratch.slot_begins),
            ("gradients", &scratch.gradients),
        ];
        if camera {
            buffers.push(("camera_sums", &scratch.camera_sums));
        }
        buffers.extend([
            ("view", view),
            ("model", &splats.model),
            ("rule", rule),
            ("tile_counts", &scratch.tile_counts),
            ("status", status),
            ("error_sums", &splats.error_sums),
            ("projected_splats", &scratch.projected_splats),
        ]);
        buffers.extend(splats.parameters());
        buffers.extend(splats.all_moments());
        passes.dispatch(
            gpu,
            update,
            u64::from(splats.n_splats.div_ceil(BLOCK)),
            &buffers,
        );
    }
}
