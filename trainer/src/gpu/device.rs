//! The device all kernels and viewers share, and its buffers.

use super::Optional;
use crate::Error;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// How to choose the adapter.
#[derive(Clone, Copy, Debug)]
pub struct GpuOptions {
    /// Whether optional features of the adapter may be used.
    pub optional_features: bool,
    /// Whether cooperative matrices are among them.
    pub matrices: bool,
    /// Whether floats may be added atomically: in an order of their own, so nothing that learns wants it.
    pub float_atomics: bool,
    /// Lowers the largest binding, bytes; for tests of buffer limits.
    pub max_binding_bytes: Option<u64>,
    /// Which of [`Gpu::adapters`]; else the fastest.
    pub adapter: Option<usize>,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self { optional_features: true, matrices: true, float_atomics: false, max_binding_bytes: None, adapter: None }
    }
}

/// One GPU, real or software.
#[derive(Debug)]
pub struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) optional: Optional,
    info: wgpu::AdapterInfo,
    limits: wgpu::Limits,
    live_bytes: Arc<AtomicU64>,
    peak_bytes: AtomicU64,
    next_id: AtomicU64,
}

/// Where compute kernels run.
const BACKENDS: wgpu::Backends = wgpu::Backends::VULKAN.union(wgpu::Backends::METAL).union(wgpu::Backends::DX12);

fn instance() -> wgpu::Instance {
    wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: BACKENDS,
        flags: wgpu::InstanceFlags::empty(),
        memory_budget_thresholds: wgpu::MemoryBudgetThresholds::default(),
        backend_options: wgpu::BackendOptions::default(),
        display: None,
    })
}

fn all_adapters(instance: &wgpu::Instance) -> Vec<wgpu::Adapter> {
    pollster::block_on(instance.enumerate_adapters(BACKENDS))
}

impl Gpu {
    /// Names of all adapters, software ones too, in the order in which the drivers list them.
    pub fn adapters() -> Vec<String> {
        all_adapters(&instance()).iter().map(|adapter| adapter.get_info().name).collect()
    }

    /// Opens the adapter that is asked for, or the fastest there is; a software one serves when there is no other.
    pub fn open(options: &GpuOptions) -> Result<Arc<Self>, Error> {
        let instance = instance();
        let adapter = match options.adapter {
            Some(ix) => {
                let mut adapters = all_adapters(&instance);
                if ix >= adapters.len() {
                    return Err(Error::NoSuchAdapter { ix, n_adapters: adapters.len() });
                }
                adapters.swap_remove(ix)
            }
            None => pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions {
                power_preference: wgpu::PowerPreference::HighPerformance,
                ..wgpu::RequestAdapterOptions::default()
            }))
            .map_err(|_| Error::NoAdapter)?,
        };
        let optional = Optional::of(&adapter, options);
        let mut limits = adapter.limits();
        if let Some(bytes) = options.max_binding_bytes {
            limits.max_storage_buffer_binding_size = limits.max_storage_buffer_binding_size.min(bytes);
        }
        let experimental_features = if optional.half_matrices {
            // SAFETY: kernels with cooperative matrices are our own; each load and store stays within its array.
            #[expect(unsafe_code, reason = "cooperative matrices are experimental in wgpu")]
            unsafe {
                wgpu::ExperimentalFeatures::enabled()
            }
        } else {
            wgpu::ExperimentalFeatures::disabled()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("fieldrig"),
            required_features: optional.features(),
            required_limits: limits.clone(),
            experimental_features,
            memory_hints: wgpu::MemoryHints::Performance,
            ..wgpu::DeviceDescriptor::default()
        }))
        .map_err(|source| Error::NoDevice { adapter: adapter.get_info().name, source })?;
        Ok(Arc::new(Self {
            device,
            queue,
            optional,
            info: adapter.get_info(),
            limits,
            live_bytes: Arc::default(),
            peak_bytes: AtomicU64::new(0),
            next_id: AtomicU64::new(0),
        }))
    }

    /// Name, kind, driver and optional features of the adapter, for people.
    pub fn describe(&self) -> String {
        let info = &self.info;
        let subgroups =
            self.optional.subgroup_lanes.map_or("no subgroups".to_owned(), |lanes| format!("subgroups of {lanes}"));
        let timestamps = if self.optional.timestamps { "timestamps" } else { "no timestamps" };
        let matrices = if self.optional.half_matrices { "matrices of f16" } else { "no matrices of f16" };
        format!(
            "{} ({:?}, {:?}, {} {}), {subgroups}, {timestamps}, {matrices}",
            info.name, info.device_type, info.backend, info.driver, info.driver_info
        )
    }

    /// Whether kernels run on the CPU.
    pub fn is_software(&self) -> bool {
        self.info.device_type == wgpu::DeviceType::Cpu
    }

    /// Optional features in use.
    pub fn optional(&self) -> Optional {
        self.optional
    }

    /// Largest buffer a kernel can see, bytes.
    pub fn max_binding_bytes(&self) -> u64 {
        self.limits.max_storage_buffer_binding_size.min(self.limits.max_buffer_size)
    }

    /// Memory that a workgroup can share, bytes.
    pub(super) fn max_workgroup_bytes(&self) -> u32 {
        self.limits.max_compute_workgroup_storage_size
    }

    /// Bytes of all live buffers.
    pub fn live_bytes(&self) -> u64 {
        self.live_bytes.load(Ordering::Relaxed)
    }

    /// Largest value of [`Self::live_bytes`] so far.
    pub fn peak_bytes(&self) -> u64 {
        self.peak_bytes.load(Ordering::Relaxed)
    }

    /// A zeroed storage buffer; refused when the adapter cannot bind it.
    pub fn storage(&self, label: &str, bytes: u64) -> Result<Buffer, Error> {
        let bytes = bytes.max(16).next_multiple_of(16);
        if bytes > self.max_binding_bytes() {
            return Err(Error::BufferTooLarge {
                label: label.to_owned(),
                bytes,
                limit_bytes: self.max_binding_bytes(),
            });
        }
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST;
        Ok(self.buffer(label, bytes, usage))
    }

    /// A storage buffer holding `contents`.
    pub fn storage_with(&self, label: &str, contents: &[u8]) -> Result<Buffer, Error> {
        let buffer = self.storage(label, contents.len() as u64)?;
        self.write(&buffer, 0, contents);
        Ok(buffer)
    }

    /// A uniform buffer holding `contents`.
    pub fn uniform_with<T: bytemuck::Pod>(&self, label: &str, contents: &T) -> Buffer {
        let bytes = bytemuck::bytes_of(contents);
        let buffer = self.buffer(label, bytes.len() as u64, wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST);
        self.write(&buffer, 0, bytes);
        buffer
    }

    /// A buffer that one kernel writes and others read as a uniform.
    pub fn uniform_and_storage(&self, label: &str, bytes: u64) -> Buffer {
        let copied = wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST;
        let usage = wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::STORAGE | copied;
        self.buffer(label, bytes, usage)
    }

    /// Writes before the next submit; a length that is no multiple of 4 is filled up with zeros.
    pub fn write(&self, buffer: &Buffer, offset_bytes: u64, contents: &[u8]) {
        let whole = contents.len() / 4 * 4;
        self.queue.write_buffer(&buffer.raw, offset_bytes, &contents[..whole]);
        if whole < contents.len() {
            let mut tail = [0; 4];
            tail[..contents.len() - whole].copy_from_slice(&contents[whole..]);
            self.queue.write_buffer(&buffer.raw, offset_bytes + whole as u64, &tail);
        }
    }

    /// Fills part of a buffer with zeros at once.
    pub fn clear(&self, buffer: &Buffer, offset_bytes: u64, bytes: u64) {
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.clear_buffer(&buffer.raw, offset_bytes, Some(bytes));
        self.queue.submit([encoder.finish()]);
    }

    /// Copies `bytes` bytes from one buffer to another at once.
    pub fn copy(&self, from: (&Buffer, u64), to: (&Buffer, u64), bytes: u64) {
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(&from.0.raw, from.1, &to.0.raw, to.1, bytes);
        self.queue.submit([encoder.finish()]);
    }

    /// Waits for the GPU and reads the first `n` elements of `buffer`.
    pub fn read<T: bytemuck::Pod>(&self, buffer: &Buffer, n: usize) -> Result<Vec<T>, Error> {
        if n == 0 {
            return Ok(Vec::new());
        }
        self.begin_read_bytes(buffer, n * size_of::<T>()).finish(self)
    }

    /// Begins to read the first `n` words of `buffer` as they are after everything submitted so far.
    pub fn begin_read(&self, buffer: &Buffer, n: usize) -> PendingRead {
        self.begin_read_bytes(buffer, 4 * n)
    }

    fn begin_read_bytes(&self, buffer: &Buffer, n_bytes: usize) -> PendingRead {
        let padded = (n_bytes as u64).next_multiple_of(4);
        let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("readback"),
            size: padded,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(&buffer.raw, 0, &staging, 0, padded);
        let submission = self.queue.submit([encoder.finish()]);
        let (sender, mapped) = std::sync::mpsc::sync_channel(1);
        staging.map_async(wgpu::MapMode::Read, .., move |result| {
            // Nobody listens any more when the read was given up.
            let _ = sender.send(result);
        });
        PendingRead { staging, submission, mapped, n_bytes }
    }

    /// Waits until everything submitted is done.
    pub fn wait(&self) -> Result<(), Error> {
        self.device
            .poll(wgpu::PollType::Wait { submission_index: None, timeout: None })
            .map_err(|_| Error::DeviceLost)?;
        Ok(())
    }

    pub(super) fn fresh_id(&self) -> u64 {
        self.next_id.fetch_add(1, Ordering::Relaxed)
    }

    fn buffer(&self, label: &str, bytes: u64, usage: wgpu::BufferUsages) -> Buffer {
        let raw = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes,
            usage,
            mapped_at_creation: false,
        });
        let live = self.live_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.peak_bytes.fetch_max(live, Ordering::Relaxed);
        Buffer { id: self.fresh_id(), raw, bytes, live_bytes: self.live_bytes.clone() }
    }
}

/// A read-back under way.
#[derive(Debug)]
pub struct PendingRead {
    staging: wgpu::Buffer,
    submission: wgpu::SubmissionIndex,
    mapped: std::sync::mpsc::Receiver<Result<(), wgpu::BufferAsyncError>>,
    n_bytes: usize,
}

impl PendingRead {
    /// Waits for the data.
    pub fn finish<T: bytemuck::Pod>(self, gpu: &Gpu) -> Result<Vec<T>, Error> {
        let wait = wgpu::PollType::Wait { submission_index: Some(self.submission), timeout: None };
        gpu.device.poll(wait).map_err(|_| Error::DeviceLost)?;
        self.mapped.recv().map_err(|_| Error::DeviceLost)?.map_err(|_| Error::DeviceLost)?;
        let view = self.staging.get_mapped_range(..).map_err(|_| Error::DeviceLost)?;
        Ok(bytemuck::pod_collect_to_vec(&view[..self.n_bytes]))
    }
}

/// Memory on the GPU; freed on drop, once the GPU is done with it.
#[derive(Debug)]
pub struct Buffer {
    pub(super) id: u64,
    pub(super) raw: wgpu::Buffer,
    bytes: u64,
    live_bytes: Arc<AtomicU64>,
}

impl Buffer {
    /// Size in bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        self.live_bytes.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}
