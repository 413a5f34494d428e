//! The device that all kernels and viewers share, and its buffers.

use crate::pipeline_cache::PipelineCache;
use crate::{Error, GpuOptions, Optional};
use parking_lot::{Mutex, RwLock};
use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;
use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// Maximum time until wgpu reports that a device is lost.
const LOSS_TIMEOUT: Duration = Duration::from_secs(5);

/// Interval between checks of the device while waiting for a read-back. It delays only the
/// detection of a lost device.
const CHECK_PERIOD: Duration = Duration::from_millis(100);
/// Size of the memory blocks that small buffers share on a software adapter. It is the smallest
/// size that wgpu accepts.
const SOFTWARE_BLOCK_BYTES: u64 = 4 << 20;
/// Maximum total size of read-back buffers kept for reuse. A 1024x1024 picture with depth takes 8
/// MiB, so four of them are kept.
const MAX_IDLE_STAGING_BYTES: u64 = 32 << 20;
/// Maximum number of read-back buffers kept for reuse. Training, pictures and scores read buffers
/// of different sizes at the same time.
const MAX_IDLE_STAGING: usize = 8;

/// One GPU, real or software.
#[derive(Debug)]
pub struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) optional: Optional,
    info: wgpu::AdapterInfo,
    limits: wgpu::Limits,
    memory_limit_bytes: u64,
    health: Arc<Health>,
    live: Arc<LiveBuffers>,
    peak_bytes: AtomicU64,
    next_id: AtomicU64,
    pub(super) pipelines: PipelineCache,
    /// Read-back buffers for reuse, the oldest first.
    idle_staging: Mutex<VecDeque<wgpu::Buffer>>,
    /// A lock that is held for reading while memory is mapped or copied, because destroying the
    /// device unmaps this memory.
    mapped: RwLock<()>,
}

/// Bytes of the buffers in use.
#[derive(Debug, Default)]
struct LiveBuffers {
    bytes: AtomicU64,
    by_label: Mutex<BTreeMap<Arc<str>, u64>>,
}

impl LiveBuffers {
    /// Counts a new buffer. Returns its label and the total bytes of all buffers.
    fn add(&self, label: &str, bytes: u64) -> (Arc<str>, u64) {
        // Labels are shared, because models create buffers with the same label many times.
        let mut by_label = self.by_label.lock();
        let key = by_label
            .get_key_value(label)
            .map_or_else(|| label.into(), |(key, _)| Arc::clone(key));
        *by_label.entry(Arc::clone(&key)).or_default() += bytes;
        (key, self.bytes.fetch_add(bytes, Ordering::Relaxed) + bytes)
    }

    fn remove(&self, label: &str, bytes: u64) {
        let mut by_label = self.by_label.lock();
        if let Some(label_bytes) = by_label.get_mut(label) {
            *label_bytes -= bytes;
        }
        self.bytes.fetch_sub(bytes, Ordering::Relaxed);
    }
}

/// Errors that the device reports outside of any call. They are permanent. Work can continue only
/// on a new device.
#[derive(Debug, Default)]
struct Health {
    /// Why the device was lost.
    lost: OnceLock<String>,
    /// The first error that no error scope caught.
    failed: OnceLock<Failure>,
}

#[derive(Debug)]
enum Failure {
    OutOfMemory,
    /// The driver failed to execute a valid command.
    Driver(String),
    /// A command was invalid.
    Invalid(String),
}

impl Health {
    fn record_error(&self, error: wgpu::Error) {
        let failure = match error {
            wgpu::Error::OutOfMemory { .. } => Failure::OutOfMemory,
            wgpu::Error::Internal { description, .. } => Failure::Driver(description),
            wgpu::Error::Validation { description, .. } => Failure::Invalid(description),
        };
        // Only the first error is kept, because later errors are usually its consequences.
        self.failed.get_or_init(|| failure);
    }

    /// Registers callbacks that record the errors of a device.
    fn of(device: &wgpu::Device) -> Arc<Self> {
        let health = Arc::<Self>::default();
        let on_loss = health.clone();
        let on_error = health.clone();
        device.set_device_lost_callback(move |reason, message| {
            log::debug!("the device was lost ({reason:?}): {message}");
            on_loss.lost.get_or_init(|| message);
        });
        // Without a handler, wgpu panics.
        device.on_uncaptured_error(Arc::new(move |error| on_error.record_error(error)));
        health
    }
}

/// Backends that support compute kernels.
const BACKENDS: wgpu::Backends = wgpu::Backends::VULKAN
    .union(wgpu::Backends::METAL)
    .union(wgpu::Backends::DX12);

fn instance() -> wgpu::Instance {
    wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: BACKENDS,
        flags: wgpu::InstanceFlags::empty(),
        memory_budget_thresholds: wgpu::MemoryBudgetThresholds::default(),
        backend_options: wgpu::BackendOptions::default(),
        display: None,
    })
}

/// The adapter with this index. Without an index, it is the fastest adapter. A software adapter is
/// used only if there is no other adapter.
fn find_adapter(
    instance: &wgpu::Instance,
    requested: Option<usize>,
) -> Result<wgpu::Adapter, Error> {
    let Some(ix) = requested else {
        return pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            ..wgpu::RequestAdapterOptions::default()
        }))
        .map_err(|_| Error::NoAdapter);
    };
    let mut adapters = all_adapters(instance);
    if ix >= adapters.len() {
        return Err(Error::NoSuchAdapter {
            ix,
            n_adapters: adapters.len(),
        });
    }
    Ok(adapters.swap_remove(ix))
}

/// Experimental features of wgpu that the optional features need.
fn experimental_features(optional: Optional) -> wgpu::ExperimentalFeatures {
    if optional.half_matrices {
        // SAFETY: only fieldrig's own kernels use cooperative matrices, and each of their loads and
        // stores stays within its array.
        #[expect(unsafe_code, reason = "cooperative matrices are experimental in wgpu")]
        unsafe {
            wgpu::ExperimentalFeatures::enabled()
        }
    } else {
        wgpu::ExperimentalFeatures::disabled()
    }
}

fn all_adapters(instance: &wgpu::Instance) -> Vec<wgpu::Adapter> {
    pollster::block_on(instance.enumerate_adapters(BACKENDS))
}

/// Allocation strategy for buffers.
///
/// By default, wgpu places buffers in shared blocks of 128 MiB or more. Buffers that grow with the
/// scene leave holes in these blocks, and a block is freed only when it is empty. In long runs,
/// blocks took more than twice the memory in use. On a software adapter, blocks are host memory.
/// There, each large buffer gets its own block, which costs only a `malloc`. Drivers of real GPUs
/// allocate blocks far more slowly and limit their number, so the default is kept for real GPUs.
fn memory_hints(device_type: wgpu::DeviceType) -> wgpu::MemoryHints {
    match device_type {
        wgpu::DeviceType::Cpu => wgpu::MemoryHints::Manual {
            suballocated_device_memory_block_size: SOFTWARE_BLOCK_BYTES..SOFTWARE_BLOCK_BYTES,
        },
        _ => wgpu::MemoryHints::Performance,
    }
}

impl Gpu {
    /// Names of all adapters, including software adapters, in the order in which the drivers list
    /// them.
    pub fn adapters() -> Vec<String> {
        all_adapters(&instance())
            .iter()
            .map(|adapter| adapter.get_info().name)
            .collect()
    }

    /// Opens the requested adapter, or the fastest adapter if none was requested. A software
    /// adapter is used only if there is no other adapter.
    ///
    /// # Errors
    ///
    /// Fails if there is no such adapter, or if it cannot open a device.
    pub fn open(options: &GpuOptions) -> Result<Arc<Self>, Error> {
        let instance = instance();
        let adapter = find_adapter(&instance, options.adapter)?;
        let optional = Optional::of(&adapter, options);
        // The limits of the adapter are requested instead of the defaults of WebGPU, because large
        // models need buffers above 128 MiB.
        let mut limits = adapter.limits();
        if let Some(bytes) = options.max_binding_bytes {
            limits.max_storage_buffer_binding_size =
                limits.max_storage_buffer_binding_size.min(bytes);
        }
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("fieldrig"),
            required_features: optional.features(),
            required_limits: limits.clone(),
            experimental_features: experimental_features(optional),
            memory_hints: memory_hints(adapter.get_info().device_type),
            ..wgpu::DeviceDescriptor::default()
        }))
        .map_err(|source| Error::NoDevice {
            adapter: adapter.get_info().name,
            source,
        })?;
        let health = Health::of(&device);
        Ok(Arc::new(Self {
            device,
            queue,
            optional,
            info: adapter.get_info(),
            limits,
            memory_limit_bytes: options.memory_limit_bytes.unwrap_or(u64::MAX),
            health,
            live: Arc::default(),
            peak_bytes: AtomicU64::new(0),
            next_id: AtomicU64::new(0),
            pipelines: PipelineCache::default(),
            idle_staging: Mutex::default(),
            mapped: RwLock::default(),
        }))
    }

    /// Name, type, driver and optional features of the adapter as text.
    pub fn describe(&self) -> String {
        let info = &self.info;
        let subgroups = self
            .optional
            .subgroup_lanes
            .map_or("no subgroups".to_owned(), |lanes| {
                format!("subgroups of {lanes}")
            });
        let timestamps = if self.optional.timestamps {
            "timestamps"
        } else {
            "no timestamps"
        };
        let matrices = if self.optional.half_matrices {
            "f16 matrices"
        } else {
            "no f16 matrices"
        };
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

    /// Largest buffer that a kernel can bind, bytes.
    pub fn max_binding_bytes(&self) -> u64 {
        self.limits
            .max_storage_buffer_binding_size
            .min(self.limits.max_buffer_size)
    }

    /// Maximum workgroup memory, bytes.
    pub(super) fn max_workgroup_bytes(&self) -> u32 {
        self.limits.max_compute_workgroup_storage_size
    }

    /// Bytes of all live buffers.
    pub fn live_bytes(&self) -> u64 {
        self.live.bytes.load(Ordering::Relaxed)
    }

    /// Bytes of all live buffers by label.
    pub fn live_bytes_by_label(&self) -> BTreeMap<Arc<str>, u64> {
        let by_label = self.live.by_label.lock();
        by_label
            .iter()
            .filter(|(_, bytes)| **bytes > 0)
            .map(|(label, bytes)| (Arc::clone(label), *bytes))
            .collect()
    }

    /// Largest value of [`Self::live_bytes`] so far.
    pub fn peak_bytes(&self) -> u64 {
        self.peak_bytes.load(Ordering::Relaxed)
    }

    /// Bytes that the allocator reserves for buffers, including unused memory. `None` if the
    /// backend does not report them. The call is slow, because it lists every allocation.
    pub fn reserved_bytes(&self) -> Option<u64> {
        Some(
            self.device
                .generate_allocator_report()?
                .total_reserved_bytes,
        )
    }

    /// Whether the device was lost. If so, nothing that was created on it can be used.
    pub fn is_lost(&self) -> bool {
        self.health.lost.get().is_some()
    }

    /// Checks the device.
    ///
    /// # Errors
    ///
    /// Fails if the device was lost, ran out of memory, failed or got an invalid command since it
    /// was opened.
    pub fn check(&self) -> Result<(), Error> {
        let failed = self.health.failed.get();
        if matches!(failed, Some(Failure::Invalid(_))) && !self.is_lost() {
            // Commands for a lost device are also invalid. wgpu reports the loss only when it is
            // polled, and when the submissions that were running have ended.
            let _ = std::panic::catch_unwind(AssertUnwindSafe(|| {
                self.device.poll(wgpu::PollType::Wait {
                    submission_index: None,
                    timeout: Some(LOSS_TIMEOUT),
                })
            }));
        }
        match failed {
            Some(Failure::OutOfMemory) => Err(Error::OutOfMemory {
                label: String::new(),
                bytes: 0,
            }),
            _ if self.is_lost() => Err(Error::DeviceLost),
            Some(Failure::Driver(message)) => Err(Error::DriverFailed(message.clone())),
            Some(Failure::Invalid(message)) => Err(Error::internal(message)),
            None => Ok(()),
        }
    }

    /// Loses the device on purpose, like a driver reset. This is for tests of recovery.
    pub fn lose(&self) {
        // Unlike a driver reset, `destroy` frees memory at once. The write lock therefore waits for
        // readers and copies first.
        let _no_reader = self.mapped.write();
        let _ = self.device.poll(wgpu::PollType::Wait {
            submission_index: None,
            timeout: None,
        });
        self.device.destroy();
    }

    /// Creates a zeroed storage buffer.
    ///
    /// # Errors
    ///
    /// Fails if the adapter cannot bind the buffer or has no memory for it.
    pub fn storage(&self, label: &str, bytes: u64) -> Result<Buffer, Error> {
        // An empty buffer cannot be bound, and arrays of `vec4f` need whole elements.
        let bytes = bytes.max(16).next_multiple_of(16);
        if bytes > self.max_binding_bytes() {
            return Err(Error::BufferTooLarge {
                label: label.to_owned(),
                bytes,
                limit_bytes: self.max_binding_bytes(),
            });
        }
        let full = || Error::OutOfMemory {
            label: label.to_owned(),
            bytes,
        };
        if self.live_bytes().saturating_add(bytes) > self.memory_limit_bytes {
            return Err(full());
        }
        let usage = wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::COPY_SRC
            | wgpu::BufferUsages::COPY_DST;
        // Callers can react to a lack of memory with smaller buffers. Outside of an error scope,
        // the lack of memory would be recorded as a permanent failure of the device.
        let memory = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let buffer = self.buffer(label, bytes, usage);
        pollster::block_on(memory.pop()).map_or(Ok(buffer), |_| Err(full()))
    }

    /// Creates a storage buffer that holds `contents`.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::storage`] does.
    pub fn storage_with(&self, label: &str, contents: &[u8]) -> Result<Buffer, Error> {
        let buffer = self.storage(label, contents.len() as u64)?;
        self.write(&buffer, 0, contents);
        Ok(buffer)
    }

    /// Creates a uniform buffer that holds `contents`.
    pub fn uniform_with<T: bytemuck::Pod>(&self, label: &str, contents: &T) -> Buffer {
        let bytes = bytemuck::bytes_of(contents);
        let buffer = self.buffer(
            label,
            bytes.len() as u64,
            wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
        );
        self.write(&buffer, 0, bytes);
        buffer
    }

    /// Creates a buffer that one kernel writes and others read as a uniform.
    pub fn uniform_and_storage(&self, label: &str, bytes: u64) -> Buffer {
        let copied = wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST;
        let usage = wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::STORAGE | copied;
        self.buffer(label, bytes, usage)
    }

    /// Writes to a buffer before the next submit. Pads `contents` with zeros to a multiple of 4
    /// bytes.
    pub fn write(&self, buffer: &Buffer, offset_bytes: u64, contents: &[u8]) {
        // wgpu writes only whole words. Only the tail is copied and padded, so that the rest need
        // not be copied.
        let whole = contents.len() / 4 * 4;
        self.queue
            .write_buffer(&buffer.raw, offset_bytes, &contents[..whole]);
        if whole < contents.len() {
            let mut tail = [0; 4];
            tail[..contents.len() - whole].copy_from_slice(&contents[whole..]);
            self.queue
                .write_buffer(&buffer.raw, offset_bytes + whole as u64, &tail);
        }
    }

    /// Fills part of a buffer with zeros, without waiting for the next submit.
    pub fn clear(&self, buffer: &Buffer, offset_bytes: u64, bytes: u64) {
        let mut encoder = self
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.clear_buffer(&buffer.raw, offset_bytes, Some(bytes));
        self.queue.submit([encoder.finish()]);
    }

    /// Copies `bytes` bytes from one buffer to another, without waiting for the next submit.
    pub fn copy(&self, from: (&Buffer, u64), to: (&Buffer, u64), bytes: u64) {
        let mut encoder = self
            .device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(&from.0.raw, from.1, &to.0.raw, to.1, bytes);
        self.queue.submit([encoder.finish()]);
    }

    /// Waits for the GPU and reads the first `n` elements of `buffer`.
    ///
    /// # Errors
    ///
    /// Fails if the device failed, or if there is no memory for the read-back.
    pub fn read<T: bytemuck::Pod>(&self, buffer: &Buffer, n: usize) -> Result<Vec<T>, Error> {
        if n == 0 {
            return Ok(Vec::new());
        }
        self.submit_reading(self.encoder(), &[(buffer, n * size_of::<T>())])
            .finish(self)
    }

    /// Begins to read the first `n` words of `buffer`, as they will be after all work submitted so
    /// far.
    pub fn begin_read(&self, buffer: &Buffer, n: usize) -> PendingRead {
        self.submit_reading(self.encoder(), &[(buffer, 4 * n)])
    }

    pub(super) fn encoder(&self) -> wgpu::CommandEncoder {
        self.device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
    }

    /// Submits the encoded commands, followed by a copy of the first bytes of each of these
    /// buffers. All copies share one read-back, so there is one wait and one mapping.
    pub(super) fn submit_reading(
        &self,
        mut encoder: wgpu::CommandEncoder,
        reads: &[(&Buffer, usize)],
    ) -> PendingRead {
        // Copies also consist of whole words only.
        let padded = |n_bytes: usize| n_bytes.next_multiple_of(4);
        let n_all_bytes = reads
            .iter()
            .map(|(_, n_bytes)| padded(*n_bytes) as u64)
            .sum();
        let Some(staging) = self.staging(n_all_bytes) else {
            // The encoded commands still run, so the state of the model does not depend on the
            // read.
            self.queue.submit([encoder.finish()]);
            return PendingRead(Err(n_all_bytes));
        };
        let mut parts = Vec::with_capacity(reads.len());
        let mut begin = 0;
        for (buffer, n_bytes) in reads {
            encoder.copy_buffer_to_buffer(
                &buffer.raw,
                0,
                &staging,
                begin as u64,
                padded(*n_bytes) as u64,
            );
            parts.push(begin..begin + n_bytes);
            begin += padded(*n_bytes);
        }
        let submission = self.queue.submit([encoder.finish()]);
        let (sender, mapped) = std::sync::mpsc::sync_channel(1);
        staging.map_async(wgpu::MapMode::Read, .., move |result| {
            // Sending fails if the read was dropped.
            let _ = sender.send(result);
        });
        PendingRead(Ok(Reading {
            staging,
            submission,
            mapped,
            parts,
        }))
    }

    /// Returns a read-back buffer, and reuses one if it fits. Returns `None` if no memory is left.
    fn staging(&self, bytes: u64) -> Option<wgpu::Buffer> {
        let bytes = bytes.max(4);
        let mut idle = self.idle_staging.lock();
        // A much larger buffer is not reused for a small read. Otherwise, a read of a few counters
        // would occupy a buffer that is needed for a picture.
        let fits = |buffer: &wgpu::Buffer| (bytes..=4 * bytes).contains(&buffer.size());
        let found = idle
            .iter()
            .enumerate()
            .filter(|(_, buffer)| fits(buffer))
            .min_by_key(|(_, buffer)| buffer.size());
        if let Some(buffer) = found.map(|(ix, _)| ix).and_then(|ix| idle.remove(ix)) {
            return Some(buffer);
        }
        // Other threads must be able to return buffers while this thread allocates.
        drop(idle);
        let memory = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("readback"),
            size: bytes,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        pollster::block_on(memory.pop())
            .is_none()
            .then_some(staging)
    }

    #[cfg(test)]
    pub(super) fn n_idle_staging(&self) -> usize {
        self.idle_staging.lock().len()
    }

    /// Keeps a read-back buffer for reuse, within [`MAX_IDLE_STAGING_BYTES`]. The least recently
    /// used buffers are dropped first.
    fn keep_staging(&self, buffer: wgpu::Buffer) {
        let mut idle = self.idle_staging.lock();
        idle.push_back(buffer);
        while idle.len() > MAX_IDLE_STAGING
            || idle.iter().map(wgpu::Buffer::size).sum::<u64>() > MAX_IDLE_STAGING_BYTES
        {
            idle.pop_front();
        }
    }

    /// Waits until everything submitted is done.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::check`] does.
    pub fn wait(&self) -> Result<(), Error> {
        self.poll(wgpu::PollType::Wait {
            submission_index: None,
            timeout: None,
        })?;
        self.check()
    }

    fn poll(&self, until: wgpu::PollType) -> Result<(), Error> {
        // Polling maps buffers, so the device must not be destroyed meanwhile.
        let _mapping = self.mapped.read();
        // wgpu panics if the device is lost during the wait. Any other panic is passed on.
        let polled = std::panic::catch_unwind(AssertUnwindSafe(|| self.device.poll(until)));
        match polled {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(_)) => Err(self.failure()),
            Err(_) if self.is_lost() => Err(self.failure()),
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }

    /// The recorded failure of the device, or an internal error if the device works.
    #[must_use]
    pub fn failure_or(&self, internal: &str) -> Error {
        self.check()
            .err()
            .unwrap_or_else(|| Error::internal(internal))
    }

    /// The recorded failure. If there is no recorded failure, it is [`Error::DeviceLost`].
    fn failure(&self) -> Error {
        self.check().err().unwrap_or(Error::DeviceLost)
    }

    pub(super) fn next_unique_id(&self) -> u64 {
        self.next_id.fetch_add(1, Ordering::Relaxed)
    }

    fn buffer(&self, label: &str, bytes: u64, usage: wgpu::BufferUsages) -> Buffer {
        let raw = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes,
            usage,
            mapped_at_creation: false,
        });
        let (label, live_bytes) = self.live.add(label, bytes);
        self.peak_bytes.fetch_max(live_bytes, Ordering::Relaxed);
        Buffer {
            id: self.next_unique_id(),
            raw,
            bytes,
            label,
            live: self.live.clone(),
        }
    }
}

/// A read-back in progress, or the size in bytes of the staging buffer that could not be allocated.
#[derive(Debug)]
pub struct PendingRead(Result<Reading, u64>);

#[derive(Debug)]
struct Reading {
    staging: wgpu::Buffer,
    submission: wgpu::SubmissionIndex,
    mapped: std::sync::mpsc::Receiver<Result<(), wgpu::BufferAsyncError>>,
    /// Range of each buffer's bytes in the staging buffer.
    parts: Vec<Range<usize>>,
}

impl PendingRead {
    /// Waits for the data of a read of one buffer.
    ///
    /// # Errors
    ///
    /// Fails if the device failed, or if there was no memory for the read-back.
    pub fn finish<T: bytemuck::Pod>(self, gpu: &Gpu) -> Result<Vec<T>, Error> {
        self.finish_with(gpu, |parts| bytemuck::pod_collect_to_vec(parts[0]))
    }

    /// Waits for the data and passes the bytes of each buffer, in the requested order, to `take`.
    ///
    /// # Errors
    ///
    /// Fails as [`Self::finish`] does.
    pub fn finish_with<R>(self, gpu: &Gpu, take: impl FnOnce(&[&[u8]]) -> R) -> Result<R, Error> {
        let reading = self.0.map_err(|bytes| Error::OutOfMemory {
            label: "readback".to_owned(),
            bytes,
        })?;
        let Reading {
            staging,
            submission,
            mapped,
            parts,
        } = reading;
        gpu.poll(wgpu::PollType::Wait {
            submission_index: Some(submission),
            timeout: None,
        })?;
        // The data are on the host now, but the callback that maps them may still have to run.
        let is_mapped = loop {
            // The callback may run on another waiting thread, and may never run if the device is
            // lost.
            match mapped.recv_timeout(CHECK_PERIOD) {
                Ok(result) => break result.is_ok(),
                Err(RecvTimeoutError::Timeout) => gpu.check()?,
                Err(RecvTimeoutError::Disconnected) => break false,
            }
        };
        if !is_mapped {
            return Err(gpu.failure());
        }
        let reading = gpu.mapped.read();
        // The device is checked before mapped memory is accessed, because destroying the device
        // unmaps it.
        gpu.check()?;
        let view = staging.get_mapped_range(..).map_err(|_| gpu.failure())?;
        let read: Vec<&[u8]> = parts.iter().map(|part| &view[part.clone()]).collect();
        let taken = take(&read);
        // The order matters, because a buffer must not be unmapped while a view of it exists.
        drop(read);
        drop(view);
        drop(reading);
        staging.unmap();
        gpu.keep_staging(staging);
        Ok(taken)
    }
}

/// Memory on the GPU. After a drop, it is freed as soon as the GPU no longer uses it.
#[derive(Debug)]
pub struct Buffer {
    pub(crate) id: u64,
    pub(super) raw: wgpu::Buffer,
    bytes: u64,
    label: Arc<str>,
    live: Arc<LiveBuffers>,
}

impl Buffer {
    /// Number that no other buffer of the same device has.
    #[must_use]
    pub fn id(&self) -> u64 {
        self.id
    }

    /// Size in bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        self.live.remove(&self.label, self.bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn live_bytes_are_counted_by_label() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let kept = gpu.storage("kept", 64).unwrap();
        let dropped: Vec<Buffer> = (0..3)
            .map(|_| gpu.storage("dropped", 32).unwrap())
            .collect();
        assert_eq!(
            gpu.live_bytes_by_label(),
            BTreeMap::from([("dropped".into(), 96), ("kept".into(), 64)])
        );
        drop(dropped);
        assert_eq!(
            gpu.live_bytes_by_label(),
            BTreeMap::from([("kept".into(), kept.bytes())])
        );
        assert_eq!((gpu.live_bytes(), gpu.peak_bytes()), (64, 160));
        assert!(gpu.reserved_bytes().is_none_or(|bytes| bytes >= 64));
    }

    /// A bug must not look like a failing GPU, because a session would then restart on another
    /// device.
    #[test]
    fn invalid_commands_are_internal_errors_and_lost_devices_are_gpu_errors() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let buffer = gpu.storage("short", 16).unwrap();
        assert!(gpu.wait().is_ok());
        gpu.clear(&buffer, 0, 32); // Beyond the end.
        let error = gpu.wait().unwrap_err();
        assert!(
            matches!(error, Error::Internal(_)) && !error.is_gpu_error(),
            "{error}"
        );

        let lost = Gpu::open(&GpuOptions::default()).unwrap();
        let buffer = lost.storage("lost", 16).unwrap();
        lost.lose();
        let error = lost.read::<u32>(&buffer, 4).unwrap_err();
        assert!(
            matches!(error, Error::DeviceLost) && error.is_gpu_error(),
            "{error}"
        );
        assert!(matches!(lost.failure_or("unused"), Error::DeviceLost));
    }

    #[test]
    fn growing_buffers_do_not_fragment_host_memory() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        if !gpu.is_software() {
            eprintln!("skipped: buffers are in host memory only on a software adapter");
            return;
        }
        let mut buffers: Vec<Buffer> = (0..8)
            .map(|_| gpu.storage("growing", 16).unwrap())
            .collect();
        for mib in 1..=24 {
            for buffer in &mut buffers {
                *buffer = gpu.storage("growing", mib << 20).unwrap();
            }
        }
        gpu.wait().unwrap();
        let live = gpu.live_bytes();
        let reserved = gpu.reserved_bytes().expect("Vulkan");
        assert!(
            live == 8 * (24 << 20) && reserved <= live + 8 * SOFTWARE_BLOCK_BYTES,
            "{reserved} bytes reserved for {live} bytes"
        );
    }
}
