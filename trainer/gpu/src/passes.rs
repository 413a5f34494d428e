//! Lists of passes, and the only code that encodes them.

use crate::{Buffer, Error, Gpu, PendingRead, Pipeline};
use std::collections::HashMap;
use std::ops::Range;

/// Maximum number of workgroups that WebGPU allows along one axis.
const MAX_GROUPS_PER_AXIS: u64 = 65_535;

/// GPU time of one pass.
#[derive(Clone, Debug, PartialEq)]
pub struct PassTiming {
    /// Name of the kernel.
    pub name: &'static str,
    /// Milliseconds.
    pub millis: f64,
}

enum Pass {
    Dispatch {
        pipeline: wgpu::ComputePipeline,
        bind_group: wgpu::BindGroup,
        groups: [u32; 2],
        name: &'static str,
    },
    Clear {
        buffer: wgpu::Buffer,
        bytes: Range<u64>,
    },
    Copy {
        from: (wgpu::Buffer, u64),
        to: (wgpu::Buffer, u64),
        bytes: u64,
    },
}

/// A list of GPU passes. Adding a pass does not touch the GPU.
///
/// Bind groups are cached across submits by kernel and buffers. [`Passes::clear_bindings`] drops
/// them.
#[derive(Default)]
pub struct Passes {
    list: Vec<Pass>,
    bind_groups: HashMap<(u64, Vec<u64>), wgpu::BindGroup>,
}

impl std::fmt::Debug for Passes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list()
            .entries(self.list.iter().map(|pass| match pass {
                Pass::Dispatch { name, groups, .. } => {
                    format!("{name} {}x{}", groups[0], groups[1])
                }
                Pass::Clear { .. } => "clear".to_owned(),
                Pass::Copy { .. } => "copy".to_owned(),
            }))
            .finish()
    }
}

impl Passes {
    /// Adds a dispatch of `n_groups` workgroups, folded onto two axes. Buffers are bound by their
    /// names in the WGSL.
    ///
    /// # Panics
    ///
    /// Panics if the names differ from the names in the kernel, which is a bug in the caller. The
    /// message lists both.
    pub fn dispatch(
        &mut self,
        gpu: &Gpu,
        pipeline: &Pipeline,
        n_groups: u64,
        buffers: &[(&str, &Buffer)],
    ) {
        if n_groups == 0 {
            return;
        }
        // The groups are folded onto as few rows as possible, of almost equal length. The number of
        // superfluous groups is less than `rows`, and kernels return early in them.
        let rows = n_groups.div_ceil(MAX_GROUPS_PER_AXIS);
        let columns = n_groups.div_ceil(rows);
        assert!(
            rows <= MAX_GROUPS_PER_AXIS,
            "{}: {n_groups} workgroups exceed the limit of a dispatch",
            pipeline.name
        );
        let found = buffers_by_binding(pipeline, buffers);
        let key = (pipeline.id, found.iter().map(|buffer| buffer.id).collect());
        // Training repeats the same dispatches thousands of times, with the same buffers.
        let bind_group = self.bind_groups.entry(key).or_insert_with(|| {
            let entries: Vec<_> = pipeline
                .bindings
                .iter()
                .zip(&found)
                .map(|(binding, buffer)| wgpu::BindGroupEntry {
                    binding: binding.number,
                    resource: buffer.raw.as_entire_binding(),
                })
                .collect();
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some(pipeline.name),
                layout: &pipeline.layout,
                entries: &entries,
            })
        });
        self.list.push(Pass::Dispatch {
            pipeline: pipeline.raw.clone(),
            bind_group: bind_group.clone(),
            groups: [u32_of(columns), u32_of(rows)],
            name: pipeline.name,
        });
    }

    /// Adds a pass that fills a buffer with zeros.
    pub fn clear(&mut self, buffer: &Buffer) {
        self.clear_range(buffer, 0..buffer.bytes());
    }

    /// Adds a pass that fills part of a buffer with zeros. Start and end must be multiples of 4.
    pub fn clear_range(&mut self, buffer: &Buffer, bytes: Range<u64>) {
        self.list.push(Pass::Clear {
            buffer: buffer.raw.clone(),
            bytes,
        });
    }

    /// Adds a copy of bytes from one buffer to another. Offsets and length must be multiples of 4.
    pub fn copy(&mut self, from: (&Buffer, u64), to: (&Buffer, u64), bytes: u64) {
        if bytes > 0 {
            self.list.push(Pass::Copy {
                from: (from.0.raw.clone(), from.1),
                to: (to.0.raw.clone(), to.1),
                bytes,
            });
        }
    }

    /// Number of passes in the list.
    pub fn len(&self) -> usize {
        self.list.len()
    }

    /// Whether the list is empty.
    pub fn is_empty(&self) -> bool {
        self.list.is_empty()
    }

    /// Drops the cached bind groups, which also frees buffers that have no other owner.
    pub fn clear_bindings(&mut self) {
        self.bind_groups.clear();
    }

    /// Submits the list and empties it.
    pub fn submit(&mut self, gpu: &Gpu) {
        let mut encoder = gpu.encoder();
        encode_all(&mut encoder, self.list.drain(..));
        gpu.queue.submit([encoder.finish()]);
    }

    /// Submits the list, empties it, and begins to read the start of each of these buffers. Each
    /// buffer is given with the number of bytes to read. The buffers are read after the passes of
    /// the list have run. All buffers share one submit and one read-back.
    pub fn submit_reading(&mut self, gpu: &Gpu, reads: &[(&Buffer, usize)]) -> PendingRead {
        let mut encoder = gpu.encoder();
        encode_all(&mut encoder, self.list.drain(..));
        gpu.submit_reading(encoder, reads)
    }

    /// Submits the list, waits, and returns the GPU time from the start of the first pass to the
    /// end of the last pass, milliseconds.
    ///
    /// Returns `None` if the adapter has no timestamps.
    ///
    /// # Errors
    ///
    /// Fails if the device failed.
    pub fn submit_timed_total(&mut self, gpu: &Gpu) -> Result<Option<f64>, Error> {
        // Unlike `submit_timed`, this writes only two timestamps around the whole list. With a pass
        // per kernel, the total would include time between kernels that a submit in training does
        // not need.
        let timed = gpu.optional.timestamps;
        let queries = timed.then(|| {
            gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("span"),
                ty: wgpu::QueryType::Timestamp,
                count: 2,
            })
        });
        let stamps = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("span"),
            size: 16,
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        // Queries can be resolved only into a buffer with a special usage, from which they are
        // copied.
        let copy = gpu.storage("span.copy", 16)?;
        let mut encoder = gpu
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        write_timestamp(&mut encoder, queries.as_ref(), true);
        encode_all(&mut encoder, self.list.drain(..));
        write_timestamp(&mut encoder, queries.as_ref(), false);
        if let Some(queries) = &queries {
            encoder.resolve_query_set(queries, 0..2, &stamps, 0);
            encoder.copy_buffer_to_buffer(&stamps, 0, &copy.raw, 0, 16);
        }
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()?;
        let ticks: Vec<u64> = gpu.read(&copy, 2)?;
        Ok(timed.then(|| {
            ticks[1].saturating_sub(ticks[0]) as f64 * f64::from(gpu.queue.get_timestamp_period())
                / 1e6
        }))
    }

    /// Submits the list with one timestamped pass per kernel, waits, and returns the GPU time of
    /// each.
    ///
    /// Returns an empty list if the adapter has no timestamps.
    ///
    /// # Errors
    ///
    /// Fails if the device failed.
    pub fn submit_timed(&mut self, gpu: &Gpu) -> Result<Vec<PassTiming>, Error> {
        if !gpu.optional.timestamps {
            self.submit(gpu);
            gpu.wait()?;
            return Ok(Vec::new());
        }
        // A timestamp can only be written at the boundaries of a pass, so every kernel gets its own
        // pass.
        let n = u32_of(self.list.len() as u64);
        let queries = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("timing"),
            ty: wgpu::QueryType::Timestamp,
            count: 2 * n.max(1),
        });
        let stamps = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("timing"),
            size: 16 * u64::from(n.max(1)),
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        let copy = gpu.storage("timing.copy", 16 * u64::from(n.max(1)))?;
        let mut encoder = gpu
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut names = Vec::new();
        for pass in self.list.drain(..) {
            match &pass {
                Pass::Clear { .. } | Pass::Copy { .. } => transfer(&mut encoder, &pass),
                Pass::Dispatch { name, .. } => {
                    let ix = u32_of(names.len() as u64);
                    let mut compute = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                        label: Some(name),
                        timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
                            query_set: &queries,
                            beginning_of_pass_write_index: Some(2 * ix),
                            end_of_pass_write_index: Some(2 * ix + 1),
                        }),
                    });
                    encode(&mut compute, &pass);
                    names.push(*name);
                }
            }
        }
        let n_stamps = 2 * names.len();
        encoder.resolve_query_set(&queries, 0..u32_of(n_stamps as u64), &stamps, 0);
        encoder.copy_buffer_to_buffer(&stamps, 0, &copy.raw, 0, 8 * n_stamps as u64);
        gpu.queue.submit([encoder.finish()]);
        let ticks: Vec<u64> = gpu.read(&copy, n_stamps)?;
        let nanos_per_tick = f64::from(gpu.queue.get_timestamp_period());
        // The subtraction saturates, in case a driver reports an end before the beginning.
        let millis = |span: &[u64]| span[1].saturating_sub(span[0]) as f64 * nanos_per_tick / 1e6;
        Ok(names
            .into_iter()
            .zip(ticks.chunks_exact(2))
            .map(|(name, span)| PassTiming {
                name,
                millis: millis(span),
            })
            .collect())
    }
}

/// The buffers of a dispatch in the order of the kernel's bindings.
fn buffers_by_binding<'b>(pipeline: &Pipeline, buffers: &[(&str, &'b Buffer)]) -> Vec<&'b Buffer> {
    let found: Option<Vec<&Buffer>> = pipeline
        .bindings
        .iter()
        .map(|binding| buffer_named(buffers, &binding.name))
        .collect();
    // A buffer that the kernel does not bind is also an error. Its name is probably misspelled.
    let Some(found) = found.filter(|found| found.len() == buffers.len()) else {
        let reads: Vec<_> = pipeline
            .bindings
            .iter()
            .map(|binding| binding.name.as_str())
            .collect();
        let given: Vec<_> = buffers.iter().map(|(name, _)| *name).collect();
        panic!("kernel {} binds {reads:?}, got {given:?}", pipeline.name);
    };
    found
}

fn buffer_named<'b>(buffers: &[(&str, &'b Buffer)], name: &str) -> Option<&'b Buffer> {
    buffers
        .iter()
        .find(|(given, _)| *given == name)
        .map(|(_, buffer)| *buffer)
}

/// Encodes an empty pass that writes one timestamp at its beginning or end.
fn write_timestamp(
    encoder: &mut wgpu::CommandEncoder,
    queries: Option<&wgpu::QuerySet>,
    first: bool,
) {
    let Some(query_set) = queries else { return };
    let timestamp_writes = Some(wgpu::ComputePassTimestampWrites {
        query_set,
        beginning_of_pass_write_index: first.then_some(0),
        end_of_pass_write_index: (!first).then_some(1),
    });
    drop(encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
        label: Some("mark"),
        timestamp_writes,
    }));
}

fn encode_all(encoder: &mut wgpu::CommandEncoder, list: impl Iterator<Item = Pass>) {
    let mut passes = list.peekable();
    while let Some(pass) = passes.next() {
        match pass {
            Pass::Clear { .. } | Pass::Copy { .. } => transfer(encoder, &pass),
            // Successive kernels share one compute pass, in which wgpu inserts the barriers between
            // dispatches.
            first @ Pass::Dispatch { .. } => {
                let mut compute =
                    encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                encode(&mut compute, &first);
                while let Some(next) = passes.next_if(|pass| matches!(pass, Pass::Dispatch { .. }))
                {
                    encode(&mut compute, &next);
                }
            }
        }
    }
}

/// Encodes a pass that runs no kernel.
fn transfer(encoder: &mut wgpu::CommandEncoder, pass: &Pass) {
    match pass {
        Pass::Dispatch { .. } => {}
        Pass::Clear { buffer, bytes } => {
            encoder.clear_buffer(buffer, bytes.start, Some(bytes.end - bytes.start))
        }
        Pass::Copy { from, to, bytes } => {
            encoder.copy_buffer_to_buffer(&from.0, from.1, &to.0, to.1, *bytes)
        }
    }
}

fn encode(compute: &mut wgpu::ComputePass<'_>, pass: &Pass) {
    let Pass::Dispatch {
        pipeline,
        bind_group,
        groups,
        ..
    } = pass
    else {
        return;
    };
    compute.set_pipeline(pipeline);
    compute.set_bind_group(0, bind_group, &[]);
    compute.dispatch_workgroups(groups[0], groups[1], 1);
}

fn u32_of(value: u64) -> u32 {
    u32::try_from(value).expect("workgroup counts are folded below 2^16 per axis")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::GpuOptions;

    #[test]
    fn reads_are_batched_and_staging_is_reused() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let first = gpu
            .storage_with("first", &[1, 2, 3, 4, 5, 6, 7, 8])
            .unwrap();
        let second = gpu
            .storage_with("second", bytemuck::cast_slice(&[0.5f32; 1000]))
            .unwrap();
        let mut list = Passes::default();
        for n in [3, 1000, 2, 1000] {
            // A copy in the list is executed before the read.
            list.copy((&second, 0), (&first, 4), 4);
            let read = list.submit_reading(&gpu, &[(&first, 7), (&second, 4 * n)]);
            assert!(list.is_empty());
            let (bytes, floats) = read
                .finish_with(&gpu, |parts| {
                    (
                        parts[0].to_vec(),
                        bytemuck::pod_collect_to_vec::<u8, f32>(parts[1]),
                    )
                })
                .unwrap();
            let half = 0.5f32.to_le_bytes();
            assert_eq!(
                bytes,
                [1, 2, 3, 4, half[0], half[1], half[2]],
                "whole words are copied, bytes are returned"
            );
            assert_eq!(floats, vec![0.5; n]);
        }
        assert_eq!(
            gpu.n_idle_staging(),
            2,
            "one for small reads, one for large ones"
        );
    }
}
