//! Stable radix sort of 32-bit keys with 32-bit values on the GPU, eight bits a pass.
//!
//! Two forms with the same result: `parallel` ranks by subgroup ballots, `sequential` gives each thread a block of its own.

use crate::Error;
use crate::gpu::{Buffer, Gpu, Kernel, Passes, Pipeline, Source};

const SHARED: &[Source] = &[
    Source { name: "view", text: include_str!("../shared/view.wgsl") },
    Source { name: "scan", text: include_str!("../shared/scan.wgsl") },
    Source { name: "digit", text: include_str!("digit.wgsl") },
];

macro_rules! kernel {
    ($name:literal) => {
        Kernel { source: Source { name: $name, text: include_str!(concat!($name, ".wgsl")) }, shared: SHARED }
    };
}

/// All kernels of this module, for validation.
pub const KERNELS: &[Kernel] = &[
    kernel!("radix_count_parallel"),
    kernel!("radix_scan_parallel"),
    kernel!("radix_scatter_parallel"),
    kernel!("radix_count_sequential"),
    kernel!("radix_scan_sequential"),
    kernel!("radix_scatter_sequential"),
];

/// Which eight bits a pass sorts by; the layout of `Digit` in digit.wgsl.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Digit {
    shift: u32,
    counter: u32,
    max_blocks: u32,
    unused: u32,
}

/// Compiled kernels of one form.
#[derive(Debug)]
pub struct RadixSort {
    parallel: bool,
    count: Pipeline,
    scan: Pipeline,
    scatter: Pipeline,
    scatter_places: Pipeline,
}

/// Memory of one sort: keys and values twice, and the digits' counts.
#[derive(Debug)]
pub struct SortBuffers {
    /// Keys and values; sorting goes back and forth between the two.
    pub keys: [Buffer; 2],
    /// Likewise.
    pub values: [Buffer; 2],
    counts: Buffer,
    totals: Buffer,
    digits: Vec<Buffer>,
    max_blocks: u32,
}

impl RadixSort {
    /// Compiles the form that suits the adapter.
    pub fn new(gpu: &Gpu) -> Result<Self, Error> {
        let parallel = !gpu.is_software() && gpu.optional().subgroup_lanes.is_some_and(|lanes| lanes >= 16);
        Self::of_form(gpu, parallel)
    }

    fn of_form(gpu: &Gpu, parallel: bool) -> Result<Self, Error> {
        let [count, scan, scatter] =
            if parallel { [KERNELS[0], KERNELS[1], KERNELS[2]] } else { [KERNELS[3], KERNELS[4], KERNELS[5]] };
        Ok(Self {
            parallel,
            count: Pipeline::new(gpu, count, &[])?,
            scan: Pipeline::new(gpu, scan, &[])?,
            scatter: Pipeline::new(gpu, scatter, &[])?,
            scatter_places: Pipeline::new(gpu, scatter, &[("VALUES_ARE_PLACES", 1.0)])?,
        })
    }

    /// Memory for up to `n_max` keys of which the low `n_bits` count; `status[counter]` will hold how many there are.
    pub fn buffers(&self, gpu: &Gpu, label: &str, n_max: u32, n_bits: u32, counter: u32) -> Result<SortBuffers, Error> {
        let max_blocks = n_max.div_ceil(self.block()).max(1);
        let words = |name: &str, n: u32| gpu.storage(&format!("{label}.{name}"), 4 * u64::from(n.max(1)));
        let digits = (0..n_bits.div_ceil(8))
            .map(|pass| gpu.uniform_with("sort.digit", &Digit { shift: 8 * pass, counter, max_blocks, unused: 0 }));
        Ok(SortBuffers {
            keys: [words("keys_a", n_max)?, words("keys_b", n_max)?],
            values: [words("values_a", n_max)?, words("values_b", n_max)?],
            counts: words("counts", 256 * max_blocks)?,
            totals: words("totals", 256)?,
            digits: digits.collect(),
            max_blocks,
        })
    }

    /// Sorts by the low `n_bits`; says which half of the buffers holds the result. The values become the places the
    /// keys had before: what they held does not matter.
    pub fn sort(&self, gpu: &Gpu, passes: &mut Passes, buffers: &SortBuffers, status: &Buffer, n_bits: u32) -> usize {
        let n_passes = n_bits.div_ceil(8) as usize;
        let n_groups = if self.parallel { buffers.max_blocks } else { buffers.max_blocks.div_ceil(8) };
        for (pass, digit) in buffers.digits[..n_passes].iter().enumerate() {
            let (from, to) = (pass % 2, 1 - pass % 2);
            let keys = &buffers.keys[from];
            let base: [(&str, &Buffer); 3] = [("digit", digit), ("status", status), ("counts", &buffers.counts)];
            passes.dispatch(gpu, &self.count, n_groups.into(), &[base[0], base[1], base[2], ("keys", keys)]);
            let scatter = if pass == 0 { &self.scatter_places } else { &self.scatter };
            let mut scattered = vec![base[0], base[1], base[2], ("keys", keys), ("values", &buffers.values[from])];
            scattered.extend([("keys_out", &buffers.keys[to]), ("values_out", &buffers.values[to])]);
            if self.parallel {
                passes.dispatch(gpu, &self.scan, 256, &[base[0], base[1], base[2], ("totals", &buffers.totals)]);
                scattered.push(("totals", &buffers.totals));
            } else {
                passes.dispatch(gpu, &self.scan, 1, &base);
            }
            passes.dispatch(gpu, scatter, n_groups.into(), &scattered);
        }
        self.half_after(n_bits)
    }

    /// Which half of the buffers holds the result of sorting by the low `n_bits`.
    pub fn half_after(&self, n_bits: u32) -> usize {
        n_bits.div_ceil(8) as usize % 2
    }

    fn block(&self) -> u32 {
        if self.parallel { 2048 } else { 256 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::GpuOptions;

    fn sorted_on_gpu(keys: &[u32], n_bits: u32, parallel: bool) -> Option<(Vec<u32>, Vec<u32>)> {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        if parallel && gpu.optional().subgroup_lanes.is_none_or(|lanes| lanes < 16) {
            eprintln!("skipped: the adapter has no subgroups of 16 or more");
            return None;
        }
        let sort = RadixSort::of_form(&gpu, parallel).unwrap();
        let n = u32::try_from(keys.len()).unwrap();
        let buffers = sort.buffers(&gpu, "test", n, n_bits, 0).unwrap();
        let status = gpu.storage_with("status", bytemuck::cast_slice(&[n])).unwrap();
        gpu.write(&buffers.keys[0], 0, bytemuck::cast_slice(keys));
        let mut passes = Passes::default();
        let half = sort.sort(&gpu, &mut passes, &buffers, &status, n_bits);
        passes.submit(&gpu);
        Some((gpu.read(&buffers.keys[half], keys.len()).unwrap(), gpu.read(&buffers.values[half], keys.len()).unwrap()))
    }

    fn check(n: u32, n_bits: u32, parallel: bool) {
        let mask = if n_bits == 32 { u32::MAX } else { (1 << n_bits) - 1 };
        let keys: Vec<u32> =
            (0..n).map(|i| i.wrapping_mul(2_654_435_761).rotate_left(7) & mask & 0xf0ff_f0ff).collect();
        let mut expected: Vec<(u32, u32)> = keys.iter().copied().zip(0..).collect();
        expected.sort_by_key(|(key, _)| *key); // Stable, as the GPU's must be.
        if let Some((sorted, places)) = sorted_on_gpu(&keys, n_bits, parallel) {
            assert_eq!(
                sorted.into_iter().zip(places).collect::<Vec<_>>(),
                expected,
                "{n} keys of {n_bits} bits, parallel {parallel}"
            );
        }
    }

    #[test]
    fn sorts_stably_at_awkward_sizes() {
        for parallel in [false, true] {
            for n in [1, 255, 256, 257, 2049, 10_000] {
                check(n, 32, parallel);
            }
            check(70_000, 16, parallel);
        }
    }
}
