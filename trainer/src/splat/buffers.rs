//! GPU buffers of the model, of one view's intersections, and of one picture.

use super::kernels::DrawPipelines;
use super::params::{Capacity, Model, TILE_PX, status};
use crate::Error;
use gpu::sort::SortBuffers;
use gpu::{Buffer, Gpu, Passes, PendingRead};
use model_files::splat::arrays::SplatArrays;

/// Splats per block, consecutive in depth. This constant and the next two equal the constants of
/// shared/bins.wgsl.
pub(crate) const BLOCK: u32 = 256;
/// Bins per workgroup.
pub(crate) const WINDOW_BINS: u32 = 256;
/// Blocks per group.
pub(crate) const GROUP: u32 = 16;

/// Constants of shared/segment.wgsl.
const SEGMENT_SPLATS: u32 = 128;
const TARGET_SEGMENTS: u32 = 16384;
const N_STATE_PARTS: u32 = 5;
const STATE_PAIRS: u32 = 128;
const HIDDEN_ENTRIES: u32 = 1024;

/// Tiles per bin.
const TILES_PER_BIN: u32 = 16;

/// Number of buffers with one entry per splat.
pub(crate) const N_PLANAR_BUFFERS: usize = 9;

/// Number of floats per splat for the SH coefficients after the constant term.
pub(crate) fn n_sh_rest(sh_degree: u32) -> u32 {
    3 * ((sh_degree + 1) * (sh_degree + 1) - 1)
}

/// Parameters and Adam's moments of the model, with capacity for `capacity` splats.
#[derive(Debug)]
pub(crate) struct SplatBuffers {
    pub(crate) n_splats: u32,
    pub(crate) capacity: u32,
    pub(crate) sh_degree: u32,
    active_degree: u32,
    /// See [`SplatArrays::is_antialiased`].
    is_antialiased: bool,
    pub(crate) model: Buffer,
    pub(crate) means: Buffer,
    pub(crate) rotations: Buffer,
    pub(crate) shapes: Buffer,
    pub(crate) sh_dc: Buffer,
    pub(crate) sh_rest: Buffer,
    pub(crate) moments: Buffer,
    pub(crate) sh_dc_moments: Buffer,
    pub(crate) sh_rest_moments: Buffer,
    pub(crate) error_sums: Buffer,
}

impl SplatBuffers {
    /// Creates an empty model with capacity for `capacity` splats of `sh_degree`.
    pub(crate) fn new(gpu: &Gpu, capacity: u32, sh_degree: u32) -> Result<Self, Error> {
        // Buffers cannot be empty.
        let capacity = capacity.max(1);
        let n = u64::from(capacity);
        let rest = u64::from(n_sh_rest(sh_degree)).max(1);
        let sizes = Model {
            n_splats: 0,
            capacity,
            sh_degree,
            n_sh_rest: n_sh_rest(sh_degree),
            is_antialiased: 0,
            unused_0: 0,
            unused_1: 0,
            unused_2: 0,
        };
        Ok(Self {
            n_splats: 0,
            capacity,
            sh_degree,
            active_degree: sh_degree,
            is_antialiased: false,
            model: gpu.uniform_with("splat.model", &sizes),
            // There is a `vec4f` per splat, because a `vec3f` takes the same space in a storage
            // buffer. The fourth component of a shape is the opacity logit.
            means: gpu.storage("splat.means", 16 * n)?,
            rotations: gpu.storage("splat.rotations", 16 * n)?,
            shapes: gpu.storage("splat.shapes", 16 * n)?,
            // There is one plane per color coefficient, so that neighboring lanes read neighboring
            // words.
            sh_dc: gpu.storage("splat.sh_dc", 12 * n)?,
            sh_rest: gpu.storage("splat.sh_rest", 4 * rest * n)?,
            // First and second moments of means, rotations and shapes, which are 2 x 3 `vec4f`.
            moments: gpu.storage("splat.moments", 96 * n)?,
            sh_dc_moments: gpu.storage("splat.sh_dc_moments", 24 * n)?,
            // All higher coefficients share one second moment. See docs/design/splats.md, section
            // "Optimizer".
            sh_rest_moments: gpu.storage("splat.sh_rest_moments", 4 * n)?,
            error_sums: gpu.storage("splat.error_sums", 4 * n)?,
        })
    }

    /// Bytes of parameters and moments.
    pub(crate) fn bytes(&self) -> u64 {
        self.planes()
            .iter()
            .map(|(buffer, _, _)| buffer.bytes())
            .sum()
    }

    /// Returns a copy with capacity for `capacity` splats of `sh_degree`, including the moments.
    pub(crate) fn resized(&self, gpu: &Gpu, capacity: u32, sh_degree: u32) -> Result<Self, Error> {
        let mut larger = Self::new(gpu, capacity, sh_degree)?;
        let stride_from = u64::from(self.capacity);
        let stride_to = u64::from(larger.capacity);
        let mut copies = Passes::default();
        for ((from, n_planes, bytes), (to, n_planes_to, _)) in
            self.planes().iter().zip(larger.planes())
        {
            // A lower degree has fewer planes of higher coefficients, which are the last planes.
            for plane in 0..u64::from(*n_planes.min(&n_planes_to)) {
                copies.copy(
                    (from, plane * stride_from * bytes),
                    (to, plane * stride_to * bytes),
                    u64::from(self.n_splats) * bytes,
                );
            }
        }
        copies.submit(gpu);
        larger.active_degree = self.active_degree.min(sh_degree);
        larger.is_antialiased = self.is_antialiased;
        larger.set_n_splats(gpu, self.n_splats);
        Ok(larger)
    }

    /// Sets the number of splats.
    pub(crate) fn set_n_splats(&mut self, gpu: &Gpu, n_splats: u32) {
        self.n_splats = n_splats;
        self.write_model(gpu);
    }

    /// Sets the active SH degree. It is limited to `sh_degree`, for which memory is allocated.
    pub(crate) fn set_active_degree(&mut self, gpu: &Gpu, degree: u32) {
        if self.active_degree != degree.min(self.sh_degree) {
            self.active_degree = degree.min(self.sh_degree);
            self.write_model(gpu);
        }
    }

    /// The SH degree in use.
    pub(crate) fn active_degree(&self) -> u32 {
        self.active_degree
    }

    fn write_model(&self, gpu: &Gpu) {
        let sizes = Model {
            n_splats: self.n_splats,
            capacity: self.capacity,
            // Kernels see only the active degree. Inactive coefficients stay unchanged.
            sh_degree: self.active_degree,
            n_sh_rest: n_sh_rest(self.active_degree),
            is_antialiased: self.is_antialiased.into(),
            unused_0: 0,
            unused_1: 0,
            unused_2: 0,
        };
        gpu.write(&self.model, 0, bytemuck::bytes_of(&sizes));
    }

    /// Appends splats. The caller must reserve capacity. Drops coefficients above this model's
    /// degree, and sets missing coefficients to zero. `is_antialiased` of `arrays` then applies to
    /// all splats of the model.
    pub(crate) fn append(&mut self, gpu: &Gpu, arrays: &SplatArrays) {
        let first = u64::from(self.n_splats);
        let n_new = arrays.means.len();
        let means: Vec<[f32; 4]> = arrays
            .means
            .iter()
            .map(|[x, y, z]| [*x, *y, *z, 0.0])
            .collect();
        let shape = |(scale, opacity): (&[f32; 3], &f32)| [scale[0], scale[1], scale[2], *opacity];
        let shapes: Vec<[f32; 4]> = arrays
            .log_scales
            .iter()
            .zip(&arrays.opacity_logits)
            .map(shape)
            .collect();
        gpu.write(&self.means, 16 * first, bytemuck::cast_slice(&means));
        gpu.write(
            &self.rotations,
            16 * first,
            bytemuck::cast_slice(&arrays.rotations_wxyz),
        );
        gpu.write(&self.shapes, 16 * first, bytemuck::cast_slice(&shapes));
        self.append_colors(gpu, arrays);
        let n_new = u32::try_from(n_new).expect("the caller ensured a capacity that fits into u32");
        self.is_antialiased = arrays.is_antialiased;
        self.set_n_splats(gpu, self.n_splats + n_new);
    }

    /// Writes the colors of new splats after the last splat.
    fn append_colors(&self, gpu: &Gpu, arrays: &SplatArrays) {
        let first = u64::from(self.n_splats);
        let n_new = arrays.means.len();
        let stride = u64::from(self.capacity);
        for channel in 0..3 {
            gpu.write(
                &self.sh_dc,
                4 * (channel as u64 * stride + first),
                bytemuck::cast_slice(&plane_of(arrays, 0, channel)),
            );
        }
        // The memory may hold the coefficients of splats that were removed, so missing coefficients
        // are cleared. A clear needs no transfer from the host, unlike a write of zeros.
        let mut zeros = Passes::default();
        for ix in 0..n_sh_rest(self.sh_degree) as usize {
            let at = 4 * (ix as u64 * stride + first);
            if 1 + ix / 3 < arrays.n_coefficients() {
                gpu.write(
                    &self.sh_rest,
                    at,
                    bytemuck::cast_slice(&plane_of(arrays, 1 + ix / 3, ix % 3)),
                );
            } else {
                zeros.clear_range(&self.sh_rest, at..at + 4 * n_new as u64);
            }
        }
        if !zeros.is_empty() {
            zeros.submit(gpu);
        }
    }

    /// Reads the parameters back.
    pub(crate) fn read(&self, gpu: &Gpu) -> Result<SplatArrays, Error> {
        if self.n_splats == 0 {
            return Ok(SplatArrays {
                sh_degree: self.sh_degree,
                is_antialiased: self.is_antialiased,
                ..SplatArrays::default()
            });
        }
        self.begin_read(gpu, self.sh_degree).finish(gpu)
    }

    /// Begins to read the parameters of at least one splat, with color coefficients up to this
    /// degree.
    pub(crate) fn begin_read(&self, gpu: &Gpu, max_sh_degree: u32) -> PendingSplats {
        let n = self.n_splats as usize;
        let stride = self.capacity as usize;
        let sh_degree = self.sh_degree.min(max_sh_degree);
        let n_rest = n_sh_rest(sh_degree) as usize;
        PendingSplats {
            means: gpu.begin_read(&self.means, 4 * n),
            rotations: gpu.begin_read(&self.rotations, 4 * n),
            shapes: gpu.begin_read(&self.shapes, 4 * n),
            // Planes are read with their gaps, in one copy.
            dc: gpu.begin_read(&self.sh_dc, 3 * stride),
            rest: (n_rest > 0).then(|| gpu.begin_read(&self.sh_rest, n_rest * stride)),
            n,
            stride,
            sh_degree,
            is_antialiased: self.is_antialiased,
        }
    }

    /// The parameters, with their binding names in the kernels.
    pub(crate) fn parameters(&self) -> [(&'static str, &Buffer); 5] {
        [
            ("means", &self.means),
            ("rotations", &self.rotations),
            ("shapes", &self.shapes),
            ("sh_dc", &self.sh_dc),
            ("sh_rest", &self.sh_rest),
        ]
    }

    /// The optimizer's moments, with their binding names in the kernels.
    pub(crate) fn all_moments(&self) -> [(&'static str, &Buffer); 3] {
        [
            ("moments", &self.moments),
            ("sh_dc_moments", &self.sh_dc_moments),
            ("sh_rest_moments", &self.sh_rest_moments),
        ]
    }

    /// Every per-splat buffer with its number of planes and its bytes per entry.
    pub(crate) fn planes(&self) -> [(&Buffer, u32, u64); N_PLANAR_BUFFERS] {
        let rest = n_sh_rest(self.sh_degree);
        [
            (&self.means, 1, 16),
            (&self.rotations, 1, 16),
            (&self.shapes, 1, 16),
            (&self.sh_dc, 3, 4),
            (&self.sh_rest, rest, 4),
            (&self.moments, 6, 16),
            (&self.sh_dc_moments, 3, 8),
            (&self.sh_rest_moments, 1, 4),
            (&self.error_sums, 1, 4),
        ]
    }
}

/// The parameters of splats, while they are being read back.
#[derive(Debug)]
pub(crate) struct PendingSplats {
    means: PendingRead,
    rotations: PendingRead,
    shapes: PendingRead,
    dc: PendingRead,
    rest: Option<PendingRead>,
    n: usize,
    stride: usize,
    sh_degree: u32,
    is_antialiased: bool,
}

impl PendingSplats {
    /// Waits for the parameters.
    pub(crate) fn finish(self, gpu: &Gpu) -> Result<SplatArrays, Error> {
        let Self {
            n,
            stride,
            sh_degree,
            is_antialiased,
            ..
        } = self;
        let means: Vec<[f32; 4]> = self.means.finish(gpu)?;
        let rotations_wxyz: Vec<[f32; 4]> = self.rotations.finish(gpu)?;
        let shapes: Vec<[f32; 4]> = self.shapes.finish(gpu)?;
        let dc: Vec<f32> = self.dc.finish(gpu)?;
        let rest: Vec<f32> = self.rest.map_or(Ok(Vec::new()), |rest| rest.finish(gpu))?;
        let n_coeffs = (sh_degree as usize + 1).pow(2);
        // The coefficients are stored in planes on the GPU, but splat by splat in host memory.
        let mut sh = Vec::with_capacity(n * n_coeffs);
        for ix in 0..n {
            sh.push([0, 1, 2].map(|channel| dc[channel * stride + ix]));
            for function in 1..n_coeffs {
                let plane = 3 * (function - 1);
                sh.push([0, 1, 2].map(|channel| rest[(plane + channel) * stride + ix]));
            }
        }
        Ok(SplatArrays {
            means: means.iter().map(|[x, y, z, _]| [*x, *y, *z]).collect(),
            log_scales: shapes.iter().map(|[x, y, z, _]| [*x, *y, *z]).collect(),
            rotations_wxyz,
            opacity_logits: shapes.iter().map(|shape| shape[3]).collect(),
            sh,
            sh_degree,
            is_antialiased,
        })
    }
}

/// The values of one color coefficient of all splats. They are zeros if the splats have no such
/// coefficient.
fn plane_of(arrays: &SplatArrays, function: usize, channel: usize) -> Vec<f32> {
    arrays
        .sh
        .chunks_exact(arrays.n_coefficients())
        .map(|coeffs| coeffs.get(function).map_or(0.0, |rgb| rgb[channel]))
        .collect()
}

/// Temporary buffers for drawing one view and training on it.
#[derive(Debug)]
pub(crate) struct Scratch {
    pub(crate) n_entries: u32,
    pub(crate) capacity: Buffer,
    /// The capacity without slots for gradients, so that pictures need no memory for gradients.
    pub(crate) capacity_for_drawing: Buffer,
    pub(crate) projected_splats: Buffer,
    pub(crate) tile_counts: Buffer,
    pub(crate) touched: Buffer,
    pub(crate) slot_offsets: Buffer,
    pub(crate) slot_begins: Buffer,
    pub(crate) block_slots: Buffer,
    pub(crate) by_depth: SortBuffers,
    pub(crate) bin_counts: Buffer,
    pub(crate) group_counts: Buffer,
    pub(crate) bin_totals: Buffer,
    pub(crate) bin_starts: Buffer,
    pub(crate) entries: Buffer,
    pub(crate) tile_bits: Buffer,
    pub(crate) gradients: Buffer,
    pub(crate) camera_sums: Buffer,
    /// Parts of the tiles' lists that `backward` processes. See shared/segment.wgsl.
    pub(crate) segments: Buffer,
    pub(crate) segment_counts: Buffer,
    pub(crate) segment_states: Buffer,
    /// Capacity for segments and for pieces of the hidden ends of lists. The capacity of one
    /// segment and of two pieces per tile is not included.
    pub(crate) n_segments: [u32; 2],
}

/// Capacities of a [`Scratch`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ScratchSize {
    pub(crate) n_splats: u32,
    /// Entries in the bin lists.
    pub(crate) n_entries: u32,
    /// Intersections of splats with tiles. It is 0 if the buffers are only for drawing.
    pub(crate) n_slots: u32,
    pub(crate) n_bins: u32,
}

impl Scratch {
    pub(crate) fn new(
        gpu: &Gpu,
        pipelines: &DrawPipelines,
        size: ScratchSize,
    ) -> Result<Self, Error> {
        let words = |name: &str, n: u32| gpu.storage(name, 4 * u64::from(n.max(1)));
        let ScratchSize {
            n_splats,
            n_entries,
            n_slots,
            n_bins,
        } = size;
        let n_blocks = n_splats.div_ceil(BLOCK);
        // Pictures and software adapters need no segments.
        let n_segments = if n_slots > 0 && pipelines.has_segments {
            n_segments(n_entries, n_slots)
        } else {
            [0; 2]
        };
        // The first segment and two pieces of each tile.
        let n_of_tiles = 3 * TILES_PER_BIN * n_bins;
        // A `Segment` has four words, which are 16 bytes.
        let segment_bytes =
            16 * (u64::from(n_segments[0]) + u64::from(n_segments[1]) + u64::from(n_of_tiles));
        // Each part of the state of each pixel of a tile takes one float.
        let state_bytes = u64::from(4 * N_STATE_PARTS * 2 * STATE_PAIRS);
        // The product is computed in u64, because it can exceed 32 bits.
        let per_bin =
            |name: &str, n: u32| gpu.storage(name, 4 * u64::from(n_bins) * u64::from(n.max(1)));
        let capacity = Capacity {
            n_entries,
            n_slots,
            n_segments: n_segments[0],
            unused: 0,
        };
        Ok(Self {
            n_entries,
            capacity: gpu.uniform_with("splat.capacity", &capacity),
            capacity_for_drawing: gpu.uniform_with(
                "splat.capacity_for_drawing",
                &Capacity {
                    n_slots: 0,
                    ..capacity
                },
            ),
            // Results of `project` and `count_bins` for each splat.
            projected_splats: gpu.storage("splat.projected_splats", 48 * u64::from(n_splats))?,
            tile_counts: words("splat.tile_counts", n_splats)?,
            touched: gpu.storage("splat.touched", 12 * u64::from(n_splats))?,
            slot_offsets: words("splat.slot_offsets", n_splats)?,
            slot_begins: words("splat.slot_begins", n_splats)?,
            block_slots: words("splat.block_slots", n_blocks)?,
            by_depth: pipelines.sort.buffers(
                gpu,
                "splat.by_depth",
                n_splats,
                status::N_SPLATS,
                status::FURTHEST,
            )?,
            // Counts that are turned into offsets. They are summed in two levels, because summing
            // thousands of blocks one by one would take too long.
            bin_counts: per_bin("splat.bin_counts", n_blocks)?,
            group_counts: per_bin("splat.group_counts", n_blocks.div_ceil(GROUP))?,
            bin_totals: words("splat.bin_totals", n_bins)?,
            bin_starts: words("splat.bin_starts", n_bins + 1)?,
            entries: gpu.storage("splat.entries", 16 * u64::from(n_entries.max(1)))?,
            // There is one bit per entry and tile of a bin, which gives 16 words for 32 entries.
            tile_bits: gpu.storage(
                "splat.tile_bits",
                64 * u64::from(n_entries.div_ceil(32).max(1)),
            )?,
            // This is the largest buffer. The gradient of every intersection has its own slot, so
            // that sums have a fixed order.
            gradients: gpu.storage("splat.gradients", 48 * u64::from(n_slots))?,
            camera_sums: gpu.storage(
                "splat.camera_sums",
                if n_slots > 0 {
                    48 * u64::from(n_blocks)
                } else {
                    0
                },
            )?,
            segments: gpu.storage("splat.segments", segment_bytes)?,
            segment_counts: words("splat.segment_counts", 2)?,
            segment_states: gpu.storage(
                "splat.segment_states",
                state_bytes * u64::from(n_segments[0]),
            )?,
            n_segments,
        })
    }
}

/// Maximum number of segments after the first segment of each tile, and maximum number of pieces of
/// hidden ends beyond two per tile, for lists of this length. See shared/segment.wgsl.
fn n_segments(n_entries: u32, n_slots: u32) -> [u32; 2] {
    // Segments are made of whole batches, so there can be twice as many as intended. An entry of a
    // bin can be in the hidden end of the lists of all of its tiles.
    [
        (n_slots / SEGMENT_SPLATS).min(2 * TARGET_SEGMENTS),
        n_entries.div_ceil(HIDDEN_ENTRIES / TILES_PER_BIN),
    ]
}

/// Buffers of one picture, and of its gradients in training.
#[derive(Debug)]
pub(crate) struct ImageBuffers {
    pub(crate) n_pixels: u32,
    pub(crate) n_tiles: u32,
    pub(crate) image: Buffer,
    pub(crate) depth: Buffer,
    pub(crate) last: Buffer,
    pub(crate) pixels: Buffer,
    pub(crate) depths: Buffer,
    pub(crate) products: Buffer,
    pub(crate) ssim_gradients: Buffer,
    pub(crate) upstream: Buffer,
    pub(crate) pixel_totals: Buffer,
    pub(crate) gain_sums: Buffer,
}

impl ImageBuffers {
    /// Allocates buffers for pictures of up to `n_pixels` and `n_tiles`, including gradients if
    /// `for_training`.
    pub(crate) fn new(
        gpu: &Gpu,
        n_pixels: u32,
        n_tiles: u32,
        for_training: bool,
    ) -> Result<Self, Error> {
        let n_trained_pixels = if for_training { n_pixels } else { 0 };
        let each = |name: &str, bytes: u64| gpu.storage(name, bytes * u64::from(n_pixels));
        let trained =
            |name: &str, bytes: u64| gpu.storage(name, bytes * u64::from(n_trained_pixels));
        let tiles = |name: &str, bytes: u64| gpu.storage(name, bytes * u64::from(n_tiles));
        Ok(Self {
            n_pixels,
            n_tiles,
            // These buffers are composited in f32, for the gradients. They contain color with
            // transmittance, depth, and the last splat that contributes.
            image: each("splat.image", 16)?,
            depth: each("splat.depth", 4)?,
            last: each("splat.last", 4)?,
            // These buffers are packed for display and scores.
            pixels: each("splat.pixels", 4)?,
            depths: each("splat.depths", 4)?,
            // Four u32 per color and workgroup of 256 pixels.
            products: gpu.storage("splat.products", 48 * u64::from(n_pixels.div_ceil(256)))?,
            // Gradients with respect to three window statistics of three colors.
            ssim_gradients: trained("splat.ssim_gradients", 36)?,
            upstream: trained("splat.upstream", 16)?,
            pixel_totals: trained("splat.pixel_totals", 8)?,
            gain_sums: tiles("splat.gain_sums", 16)?,
        })
    }
}

/// Number of bins of 4 x 4 tiles in an image.
pub(crate) fn n_bins(size_px: [u32; 2]) -> u32 {
    size_px[0].div_ceil(4 * TILE_PX) * size_px[1].div_ceil(4 * TILE_PX)
}

/// Number of tiles in an image.
pub(crate) fn n_tiles(size_px: [u32; 2]) -> u32 {
    size_px[0].div_ceil(TILE_PX) * size_px[1].div_ceil(TILE_PX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splat::kernels::KERNELS;
    use gpu::testing::constant_in_wgsl;

    #[test]
    fn constants_equal_those_in_wgsl() {
        let in_rust = [
            ("BLOCK", BLOCK),
            ("WINDOW_BINS", WINDOW_BINS),
            ("GROUP", GROUP),
            ("SEGMENT_SPLATS", SEGMENT_SPLATS),
            ("TARGET_SEGMENTS", TARGET_SEGMENTS),
            ("N_STATE_PARTS", N_STATE_PARTS),
            ("STATE_PAIRS", STATE_PAIRS),
            ("HIDDEN_ENTRIES", HIDDEN_ENTRIES),
        ];
        for (name, value) in in_rust {
            assert_eq!(constant_in_wgsl(KERNELS, name), value, "{name}");
        }
        assert_eq!(
            constant_in_wgsl(KERNELS, "BIN_TILES").pow(2),
            TILES_PER_BIN,
            "along both axes of the image"
        );
    }
}
