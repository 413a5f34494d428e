//! Stable radix sort of 32-bit keys on the GPU in two passes of eight bits. Keys are first reduced
//! to 16 bits, relative to the smallest and the largest key. Returns the original indices of the
//! sorted keys.
//!
//! Two variants give the same result. `parallel` ranks keys by subgroup ballots. `sequential`
//! assigns one block of keys to each thread.

use crate::shared::{FOLDED, SCAN};
use crate::{Buffer, Error, Gpu, Kernel, Passes, Pipeline, Source};

macro_rules! source {
    ($name:literal, $file:literal) => {
        Source {
            name: $name,
            text: include_str!($file),
        }
    };
}

const DIGIT: Source = source!("digit", "digit.wgsl");
const SHARED: &[Source] = &[FOLDED, SCAN, DIGIT, source!("peers", "peers_32.wgsl")];
const SHARED_WIDE: &[Source] = &[FOLDED, SCAN, DIGIT, source!("peers", "peers_128.wgsl")];

macro_rules! kernel {
    ($name:literal) => {
        kernel!($name, SHARED)
    };
    ($name:literal, $shared:expr) => {
        Kernel {
            source: Source {
                name: $name,
                text: include_str!(concat!($name, ".wgsl")),
            },
            shared: $shared,
        }
    };
}

/// All kernels of this module, for validation.
#[cfg(test)]
const KERNELS: &[Kernel] = &[
    kernel!("radix_count_parallel"),
    kernel!("radix_scan_parallel"),
    kernel!("radix_scatter_parallel"),
    kernel!("radix_scatter_parallel", SHARED_WIDE),
    kernel!("radix_count_sequential"),
    kernel!("radix_scan_sequential"),
    kernel!("radix_scatter_sequential"),
];

/// The eight bits that a pass sorts by. The struct has the layout of `Digit` in digit.wgsl.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Digit {
    shift: u32,
    counter: u32,
    largest: u32,
    max_blocks: u32,
}

/// Compiled kernels of one variant.
#[derive(Debug)]
pub struct RadixSort {
    parallel: bool,
    count: Pipeline,
    scan: Pipeline,
    scatter: Pipeline,
    scatter_indices: Pipeline,
}

/// Buffers of one sort. There are two buffers for keys, two for values, and one for the digit
/// counts.
#[derive(Debug)]
pub struct SortBuffers {
    /// Keys. Sorting alternates between the two buffers.
    pub keys: [Buffer; 2],
    /// Values. Sorting alternates between the two buffers.
    pub values: [Buffer; 2],
    counts: Buffer,
    totals: Buffer,
    digits: [Buffer; 2],
    max_blocks: u32,
}

impl RadixSort {
    /// Compiles the variant that suits the adapter.
    ///
    /// # Errors
    ///
    /// Fails if a kernel is invalid.
    pub fn new(gpu: &Gpu) -> Result<Self, Error> {
        // The parallel scatter has ranks for 16 subgroups of its 256 threads, so subgroups need 16
        // lanes. On a CPU, barriers are expensive.
        let parallel = !gpu.is_software()
            && gpu
                .optional()
                .subgroup_lanes
                .is_some_and(|lanes| lanes >= 16);
        Self::with_form(gpu, parallel)
    }

    fn with_form(gpu: &Gpu, parallel: bool) -> Result<Self, Error> {
        let wide = gpu
            .optional()
            .subgroup_lanes
            .is_some_and(|lanes| lanes > 32);
        // A ballot of up to 32 lanes fits into one word. The kernel for wide subgroups compares
        // four words.
        let [count, scan, scatter] = if parallel {
            [
                kernel!("radix_count_parallel"),
                kernel!("radix_scan_parallel"),
                if wide {
                    kernel!("radix_scatter_parallel", SHARED_WIDE)
                } else {
                    kernel!("radix_scatter_parallel")
                },
            ]
        } else {
            [
                kernel!("radix_count_sequential"),
                kernel!("radix_scan_sequential"),
                kernel!("radix_scatter_sequential"),
            ]
        };
        Ok(Self {
            parallel,
            count: Pipeline::new(gpu, count, &[])?,
            scan: Pipeline::new(gpu, scan, &[])?,
            scatter: Pipeline::new(gpu, scatter, &[])?,
            scatter_indices: Pipeline::new(gpu, scatter, &[("VALUES_ARE_INDICES", 1.0)])?,
        })
    }

    /// Allocates buffers for up to `n_max` keys. When keys are sorted, `status[counter]` must hold
    /// their number, `status[largest]` must hold the largest key, and the next word must hold the
    /// inverted smallest key. Keys with all bits set are excluded from this range and sorted last.
    ///
    /// # Errors
    ///
    /// Fails if the adapter has no memory for the buffers or cannot bind them.
    pub fn buffers(
        &self,
        gpu: &Gpu,
        label: &str,
        n_max: u32,
        counter: u32,
        largest: u32,
    ) -> Result<SortBuffers, Error> {
        // The number of keys is known only on the GPU, so dispatches and buffers are sized for the
        // largest number.
        let max_blocks = n_max.div_ceil(self.block()).max(1);
        let words =
            |name: &str, n: u32| gpu.storage(&format!("{label}.{name}"), 4 * u64::from(n.max(1)));
        let digits = [0, 8].map(|shift| {
            gpu.uniform_with(
                "sort.digit",
                &Digit {
                    shift,
                    counter,
                    largest,
                    max_blocks,
                },
            )
        });
        Ok(SortBuffers {
            keys: [words("keys_a", n_max)?, words("keys_b", n_max)?],
            values: [words("values_a", n_max)?, words("values_b", n_max)?],
            counts: words("counts", 256 * max_blocks)?,
            totals: words("totals", 256)?,
            digits,
            max_blocks,
        })
    }

    /// Records the passes of a sort. The results are in the first keys and values buffers. The
    /// values are replaced by the original indices of the keys. The previous content of the values
    /// does not matter.
    pub fn sort(&self, gpu: &Gpu, passes: &mut Passes, buffers: &SortBuffers, status: &Buffer) {
        // Sequential kernels assign a thread, not a workgroup, to each block. Eight threads share a
        // workgroup.
        let n_groups = if self.parallel {
            buffers.max_blocks
        } else {
            buffers.max_blocks.div_ceil(8)
        };
        for (pass, digit) in buffers.digits.iter().enumerate() {
            // There are two passes, so the results are in the first buffers again.
            let from = pass % 2;
            let to = 1 - pass % 2;
            let keys = &buffers.keys[from];
            let base: [(&str, &Buffer); 3] = [
                ("digit", digit),
                ("status", status),
                ("counts", &buffers.counts),
            ];
            passes.dispatch(
                gpu,
                &self.count,
                n_groups.into(),
                &[base[0], base[1], base[2], ("keys", keys)],
            );
            // The first pass writes the indices, so no other pass has to fill the values with 0, 1,
            // 2 and so on.
            let scatter = if pass == 0 {
                &self.scatter_indices
            } else {
                &self.scatter
            };
            let mut scatter_buffers = vec![
                base[0],
                base[1],
                base[2],
                ("keys", keys),
                ("values", &buffers.values[from]),
            ];
            scatter_buffers.extend([
                ("keys_out", &buffers.keys[to]),
                ("values_out", &buffers.values[to]),
            ]);
            // In the parallel scan, the workgroup of each digit sums its own row of counts. The
            // scatter then adds the totals of smaller digits.
            if self.parallel {
                passes.dispatch(
                    gpu,
                    &self.scan,
                    256,
                    &[base[0], base[1], base[2], ("totals", &buffers.totals)],
                );
                scatter_buffers.push(("totals", &buffers.totals));
            } else {
                passes.dispatch(gpu, &self.scan, 1, &base);
            }
            passes.dispatch(gpu, scatter, n_groups.into(), &scatter_buffers);
        }
    }

    /// Number of keys in a block. With smaller blocks, there are more counts and scans. With larger
    /// blocks, fewer blocks run in parallel. The kernels contain the same numbers.
    fn block(&self) -> u32 {
        if self.parallel { 2048 } else { 256 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_layout, assert_valid, test_gpu};

    fn sorted_on_gpu(keys: &[u32], key_range: [u32; 2], parallel: bool) -> (Vec<u32>, Vec<u32>) {
        let gpu = test_gpu();
        let sort = RadixSort::with_form(&gpu, parallel).unwrap();
        let n = u32::try_from(keys.len()).unwrap();
        let buffers = sort.buffers(&gpu, "test", n, 0, 1).unwrap();
        let status = gpu
            .storage_with(
                "status",
                bytemuck::cast_slice(&[n, key_range[1], !key_range[0]]),
            )
            .unwrap();
        gpu.write(&buffers.keys[0], 0, bytemuck::cast_slice(keys));
        let mut passes = Passes::default();
        sort.sort(&gpu, &mut passes, &buffers, &status);
        passes.submit(&gpu);
        (
            gpu.read(&buffers.keys[0], keys.len()).unwrap(),
            gpu.read(&buffers.values[0], keys.len()).unwrap(),
        )
    }

    fn check(n: u32, span: u32, parallel: bool) {
        const MIN_KEY: u32 = 1000;
        let key = |i: u32| match i % 7 {
            3 => u32::MAX,
            _ => MIN_KEY + i.wrapping_mul(2_654_435_761).rotate_left(7) % (span + 1),
        };
        let keys: Vec<u32> = (0..n).map(key).collect();
        let counted_keys = || keys.iter().copied().filter(|key| *key != u32::MAX);
        let key_range = [counted_keys().min().unwrap(), counted_keys().max().unwrap()];
        let shift = (32 - (key_range[1] - key_range[0]).leading_zeros()).saturating_sub(16);
        let mut expected: Vec<(u32, u32)> = keys.iter().copied().zip(0..).collect();
        // This sort is stable, like the sort on the GPU.
        expected.sort_by_key(|(key, _)| match *key {
            u32::MAX => 0xffff,
            key => ((key - key_range[0]) >> shift).min(0xfffe),
        });
        let (sorted, indices) = sorted_on_gpu(&keys, key_range, parallel);
        let got: Vec<(u32, u32)> = sorted.into_iter().zip(indices).collect();
        assert_eq!(got, expected, "{n} keys over {span}, parallel {parallel}");
    }

    fn check_sizes(parallel: bool) {
        for n in [1, 255, 256, 257, 2049, 10_000] {
            check(n, 50_000, parallel);
        }
        check(70_000, 0xffff, parallel);
        check(70_000, u32::MAX - 2000, parallel);
    }

    #[test]
    fn sort_is_stable_at_block_boundaries() {
        check_sizes(false);
    }

    mod needs_large_subgroups {
        use crate::testing::options_with_large_subgroups;

        #[test]
        fn parallel_sort_is_stable_at_block_boundaries() {
            if options_with_large_subgroups().is_some() {
                super::check_sizes(true);
            }
        }
    }

    #[test]
    fn structs_have_the_same_layout_in_rust_and_wgsl() {
        assert_layout!(KERNELS, Digit, [shift, counter, largest, max_blocks]);
    }

    #[test]
    fn every_kernel_is_valid() {
        assert_valid(KERNELS);
    }
}
