//! The kernels of this model, compiled.

use crate::Error;
use crate::gpu::{Gpu, Kernel, Pipeline, Source};
use crate::sort::RadixSort;

macro_rules! shared {
    ($($name:literal),*) => {
        &[$(Source { name: $name, text: include_str!(concat!("../shared/", $name, ".wgsl")) }),*,
          Source { name: "handover", text: include_str!("../shared/handover_subgroup.wgsl") }]
    };
}

const SHARED: &[Source] = shared!("view", "status", "projection", "tiles", "model", "sh", "scan", "random", "supervision", "growth", "scan_f32");
const SHARED_WITHOUT_SUBGROUPS: &[Source] = &[
    Source { name: "handover", text: include_str!("../shared/handover_memory.wgsl") },
    SHARED[0],
    SHARED[1],
    SHARED[2],
    SHARED[4],
];

macro_rules! kernel {
    ($name:literal) => {
        Kernel { source: Source { name: $name, text: include_str!(concat!($name, ".wgsl")) }, shared: SHARED }
    };
    ($folder:literal, $name:literal) => {
        Kernel { source: Source { name: $name, text: include_str!(concat!("../", $folder, "/", $name, ".wgsl")) }, shared: SHARED }
    };
}

const BACKWARD: Kernel = kernel!("backward");
const BACKWARD_WITHOUT_SUBGROUPS: Kernel = Kernel { source: BACKWARD.source, shared: SHARED_WITHOUT_SUBGROUPS };

/// All kernels of this module, for validation.
pub const KERNELS: &[Kernel] = &[
    kernel!("project"),
    kernel!("count_blocks"),
    kernel!("scan_blocks"),
    kernel!("emit"),
    kernel!("ranges"),
    kernel!("bucket_offsets"),
    kernel!("rasterize"),
    kernel!("finish"),
    kernel!("loss", "ssim"),
    kernel!("loss", "loss_backward"),
    BACKWARD,
    BACKWARD_WITHOUT_SUBGROUPS,
    kernel!("update"),
    kernel!("advance"),
    kernel!("grow_weigh"),
    kernel!("grow_scan"),
    kernel!("grow_child"),
    kernel!("grow_parent"),
];

/// What drawing needs.
#[derive(Debug)]
pub(crate) struct DrawPipelines {
    pub(crate) sort: RadixSort,
    pub(crate) project: Pipeline,
    pub(crate) count_blocks: Pipeline,
    pub(crate) scan_blocks: Pipeline,
    pub(crate) emit: Pipeline,
    pub(crate) ranges: Pipeline,
    pub(crate) bucket_offsets: Pipeline,
    pub(crate) rasterize: Pipeline,
    pub(crate) finish: Pipeline,
}

impl DrawPipelines {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, Error> {
        Ok(Self {
            sort: RadixSort::new(gpu)?,
            project: Pipeline::new(gpu, kernel!("project"), &[])?,
            count_blocks: Pipeline::new(gpu, kernel!("count_blocks"), &[])?,
            scan_blocks: Pipeline::new(gpu, kernel!("scan_blocks"), &[])?,
            emit: Pipeline::new(gpu, kernel!("emit"), &[])?,
            ranges: Pipeline::new(gpu, kernel!("ranges"), &[])?,
            bucket_offsets: Pipeline::new(gpu, kernel!("bucket_offsets"), &[])?,
            rasterize: Pipeline::new(gpu, kernel!("rasterize"), &[("STATES", 0.0)])?,
            finish: Pipeline::new(gpu, kernel!("finish"), &[])?,
        })
    }
}

/// What learning needs on top.
#[derive(Debug)]
pub(crate) struct LearnPipelines {
    pub(crate) rasterize: Pipeline,
    pub(crate) ssim: Pipeline,
    pub(crate) loss: Pipeline,
    pub(crate) loss_without_ssim: Pipeline,
    pub(crate) backward: Pipeline,
    pub(crate) update: Pipeline,
    pub(crate) advance: Pipeline,
    pub(crate) grow_weigh: Pipeline,
    pub(crate) grow_scan: Pipeline,
    pub(crate) grow_child: Pipeline,
    pub(crate) grow_parent: Pipeline,
}

impl LearnPipelines {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, Error> {
        let lanes = gpu.optional().subgroup_lanes.filter(|lanes| *lanes <= 32);
        let (backward, lanes) = lanes.map_or((BACKWARD_WITHOUT_SUBGROUPS, 32), |lanes| (BACKWARD, lanes));
        Ok(Self {
            rasterize: Pipeline::new(gpu, kernel!("rasterize"), &[("STATES", 1.0)])?,
            ssim: Pipeline::new(gpu, kernel!("loss", "ssim"), &[])?,
            loss: Pipeline::new(gpu, kernel!("loss", "loss_backward"), &[("SSIM", 1.0)])?,
            loss_without_ssim: Pipeline::new(gpu, kernel!("loss", "loss_backward"), &[("SSIM", 0.0)])?,
            backward: Pipeline::new(gpu, backward, &[("LANES", lanes.into())])?,
            update: Pipeline::new(gpu, kernel!("update"), &[])?,
            advance: Pipeline::new(gpu, kernel!("advance"), &[])?,
            grow_weigh: Pipeline::new(gpu, kernel!("grow_weigh"), &[])?,
            grow_scan: Pipeline::new(gpu, kernel!("grow_scan"), &[])?,
            grow_child: Pipeline::new(gpu, kernel!("grow_child"), &[])?,
            grow_parent: Pipeline::new(gpu, kernel!("grow_parent"), &[])?,
        })
    }

    /// The update kernel that hands out gradients in place of new values, for comparison with the twin.
    #[cfg(test)]
    pub(crate) fn gradients_only(gpu: &Gpu) -> Result<Pipeline, Error> {
        Pipeline::new(gpu, kernel!("update"), &[("GRADIENTS_ONLY", 1.0)])
    }
}

#[cfg(test)]
mod tests {
    use crate::gpu::{reflect, resolve};

    #[test]
    fn every_kernel_parses_and_validates() {
        let kernels = super::KERNELS.iter().chain(crate::sort::KERNELS);
        let refused: Vec<String> = kernels
            .filter_map(|kernel| resolve(kernel.source, kernel.shared).and_then(|text| reflect(kernel.source.name, &text).map(|_| ())).err())
            .map(|error| error.to_string())
            .collect();
        assert!(refused.is_empty(), "{}", refused.join("\n"));
    }
}
