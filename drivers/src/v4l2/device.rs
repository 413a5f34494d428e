//! An open V4L2 device, with safe calls for the requests of the kernel, and with images in memory
//! that is shared with the kernel.

use super::abi::{self, Plain, Request};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::{AsFd, OwnedFd};
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use rustix::ioctl::{Ioctl, IoctlOutput, Opcode};
use rustix::mm::{MapFlags, ProtFlags};
use std::ffi::c_void;
use std::path::Path;
use std::time::Duration;

/// An open device. Dropping it stops its stream and closes it.
#[derive(Debug)]
pub(super) struct Device {
    fd: OwnedFd,
}

/// Identity reported by a device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Identity {
    /// Model name.
    pub(super) card: String,
    /// Bus address.
    pub(super) bus: String,
    /// Whether the node supports streaming images. Other nodes of the same camera may only deliver
    /// metadata.
    pub(super) streams_images: bool,
}

/// An image buffer filled by the device.
#[derive(Clone, Copy, Debug)]
pub(super) struct FilledBuffer {
    index: u32,
    n_bytes: usize,
    /// Sequence number since the stream started, including lost images.
    pub(super) sequence: u32,
    /// Stamp in nanoseconds. Its clock depends on `is_monotonic`.
    pub(super) stamp_nanos: i64,
    /// Whether the device reports that its stamps come from the kernel's monotonic clock.
    pub(super) is_monotonic: bool,
    /// Whether the device reports damaged data.
    pub(super) is_damaged: bool,
}

/// Passes a structure to the kernel and back.
struct Exchange<'a, T> {
    code: Opcode,
    value: &'a mut T,
}

// SAFETY: the kernel writes at most the structure whose size is in the code, and `Request` pairs
// each code with its structure. The sizes are asserted in `abi`. The structures consist of
// integers, so any written bytes are valid.
#[expect(unsafe_code, reason = "system call")]
unsafe impl<T: Plain> Ioctl for Exchange<'_, T> {
    type Output = ();
    const IS_MUTATING: bool = true;

    fn opcode(&self) -> Opcode {
        self.code
    }

    fn as_ptr(&mut self) -> *mut c_void {
        std::ptr::from_mut(self.value).cast()
    }

    unsafe fn output_from_ptr(_: IoctlOutput, _: *mut c_void) -> rustix::io::Result<()> {
        Ok(())
    }
}

impl Device {
    /// Opens a node in nonblocking mode.
    pub(super) fn open(path: &Path) -> rustix::io::Result<Self> {
        // The node is opened in nonblocking mode, so that a device that stops sending cannot block
        // the thread. `wait` has a timeout, but `DQBUF` has no timeout. The descriptor is closed in
        // child processes, which would otherwise keep the device busy.
        let flags = OFlags::RDWR | OFlags::NONBLOCK | OFlags::CLOEXEC;
        Ok(Self {
            fd: rustix::fs::open(path, flags, Mode::empty())?,
        })
    }

    /// Executes a request. It is repeated if interrupted by a signal.
    fn ioctl<T: Plain>(&self, request: &Request<T>, value: &mut T) -> rustix::io::Result<()> {
        rustix::io::retry_on_intr(|| {
            // SAFETY: the code belongs to the structure `T` (see `Exchange`), which outlives the
            // call. None of the structures contains a pointer that the kernel follows.
            #[expect(unsafe_code, reason = "system call")]
            unsafe {
                rustix::ioctl::ioctl(
                    &self.fd,
                    Exchange {
                        code: request.code(),
                        value: &mut *value,
                    },
                )
            }
        })
    }

    /// Enumerates entries with increasing indices until the device has no more entries. The list is
    /// empty if the device does not support the request.
    fn list<T: Plain>(&self, request: &Request<T>, mut request_at: impl FnMut(u32) -> T) -> Vec<T> {
        // This limit ends the loop even if a driver never ends its list.
        const MAX_ENTRIES: u32 = 1000;
        let entry = |index| {
            let mut entry = request_at(index);
            self.ioctl(request, &mut entry).is_ok().then_some(entry)
        };
        (0..MAX_ENTRIES).map_while(entry).collect()
    }

    pub(super) fn identity(&self) -> rustix::io::Result<Identity> {
        let mut reported = abi::Capability::default();
        self.ioctl(&abi::QUERYCAP, &mut reported)?;
        // `capabilities` covers all nodes of a device, and `device_caps` covers only this node. Old
        // drivers report only `capabilities`.
        let of_node = if reported.capabilities & abi::CAP_DEVICE_CAPS == 0 {
            reported.capabilities
        } else {
            reported.device_caps
        };
        let required = abi::CAP_VIDEO_CAPTURE | abi::CAP_STREAMING;
        Ok(Identity {
            card: abi::text(&reported.card),
            bus: abi::text(&reported.bus_info),
            streams_images: of_node & required == required,
        })
    }

    /// Codes of the supported pixel formats, in the order of the device.
    pub(super) fn fourccs(&self) -> Vec<u32> {
        let request_at = |index| abi::FormatDescription {
            index,
            kind: abi::VIDEO_CAPTURE,
            ..Default::default()
        };
        self.list(&abi::ENUM_FMT, request_at)
            .iter()
            .map(|format| format.fourcc)
            .collect()
    }

    /// Supported sizes of a format.
    pub(super) fn sizes(&self, fourcc: u32) -> Vec<abi::FrameSize> {
        self.list(&abi::ENUM_FRAMESIZES, |index| abi::FrameSize {
            index,
            fourcc,
            ..Default::default()
        })
    }

    /// Supported intervals between images of a format at a size.
    pub(super) fn intervals(
        &self,
        fourcc: u32,
        [width, height]: [u32; 2],
    ) -> Vec<abi::FrameInterval> {
        let request_at = |index| abi::FrameInterval {
            index,
            fourcc,
            width,
            height,
            ..Default::default()
        };
        self.list(&abi::ENUM_FRAMEINTERVALS, request_at)
    }

    /// Requests a format and returns the format that the device selected.
    pub(super) fn set_format(
        &self,
        fourcc: u32,
        [width, height]: [u32; 2],
    ) -> rustix::io::Result<abi::PixFormat> {
        let pix = abi::PixFormat {
            width,
            height,
            fourcc,
            // Interlaced rows are exposed at two different times, which no lens model here
            // describes.
            field: abi::FIELD_NONE,
            ..Default::default()
        };
        let mut format = abi::Format {
            kind: abi::VIDEO_CAPTURE,
            padding: 0,
            pix,
            rest: [0; 19],
        };
        self.ioctl(&abi::S_FMT, &mut format)?;
        Ok(format.pix)
    }

    /// Requests a rate in images per second and returns the rate that the device selected, or
    /// `None` if the rate cannot be set.
    pub(super) fn set_rate_hz(&self, rate_hz: f64) -> rustix::io::Result<Option<f64>> {
        let mut parm = abi::StreamParm {
            kind: abi::VIDEO_CAPTURE,
            capture: Default::default(),
            rest: [0; 40],
        };
        // The other parameters are read first, because `S_PARM` sets all of them.
        if self.ioctl(&abi::G_PARM, &mut parm).is_err()
            || parm.capture.capability & abi::CAP_TIMEPERFRAME == 0
        {
            return Ok(None);
        }
        parm.capture.time_per_frame = super::format::interval_of(rate_hz);
        self.ioctl(&abi::S_PARM, &mut parm)?;
        Ok(Some(super::format::rate_of(parm.capture.time_per_frame)))
    }

    /// Whether the input is a high-definition television signal, as with an HDMI grabber.
    pub(super) fn is_hdtv(&self) -> bool {
        let mut index = 0;
        if self.ioctl(&abi::G_INPUT, &mut index).is_err() {
            return false;
        }
        let mut input = abi::Input {
            index,
            ..Default::default()
        };
        self.ioctl(&abi::ENUMINPUT, &mut input).is_ok()
            && input.capabilities & abi::INPUT_DV_TIMINGS != 0
    }

    /// Description of a control. `None` if the device has no writable control with this id.
    pub(super) fn control(&self, id: u32) -> Option<abi::QueryControl> {
        let mut control = abi::QueryControl {
            id,
            ..Default::default()
        };
        self.ioctl(&abi::QUERYCTRL, &mut control).ok()?;
        (control.flags & (abi::CONTROL_DISABLED | abi::CONTROL_READ_ONLY) == 0).then_some(control)
    }

    /// Entries of a menu control that this device supports.
    pub(super) fn menu(&self, id: u32, range: std::ops::RangeInclusive<i32>) -> Vec<i32> {
        range.filter(|entry| self.has_entry(id, *entry)).collect()
    }

    /// Whether a menu has this entry. Menus may have gaps, which the kernel reports as errors.
    fn has_entry(&self, id: u32, entry: i32) -> bool {
        let Ok(index) = u32::try_from(entry) else {
            return false;
        };
        let mut menu = abi::QueryMenu {
            id,
            index,
            ..Default::default()
        };
        self.ioctl(&abi::QUERYMENU, &mut menu).is_ok()
    }

    pub(super) fn control_value(&self, id: u32) -> rustix::io::Result<i32> {
        let mut control = abi::Control { id, value: 0 };
        self.ioctl(&abi::G_CTRL, &mut control)?;
        Ok(control.value)
    }

    pub(super) fn set_control(&self, id: u32, value: i32) -> rustix::io::Result<()> {
        self.ioctl(&abi::S_CTRL, &mut abi::Control { id, value })
    }

    /// Allocates buffers and starts the stream. `n_buffers` buffers are requested, but the device
    /// may use more or fewer.
    pub(super) fn stream(self, n_buffers: u32) -> Result<Stream, Refused> {
        let mut requested = abi::RequestBuffers {
            count: n_buffers,
            kind: abi::VIDEO_CAPTURE,
            memory: abi::MEMORY_MMAP,
            ..Default::default()
        };
        self.ioctl(&abi::REQBUFS, &mut requested)
            .map_err(Refused::Buffers)?;
        let mut buffers = Vec::new();
        for index in 0..requested.count {
            let mut buffer = buffer_of(index);
            self.ioctl(&abi::QUERYBUF, &mut buffer)
                .map_err(Refused::Buffers)?;
            // Every buffer is mapped before the device may write to it.
            buffers.push(Mapped::new(&self.fd, &buffer).map_err(Refused::Buffers)?);
            self.ioctl(&abi::QBUF, &mut buffer_of(index))
                .map_err(Refused::Buffers)?;
        }
        self.ioctl(&abi::STREAMON, &mut abi::VIDEO_CAPTURE.clone())
            .map_err(Refused::Begin)?;
        Ok(Stream {
            device: self,
            buffers,
        })
    }
}

/// Step at which a stream was rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Refused {
    /// The buffers cannot be allocated. There is no memory for images, or another program uses the
    /// device.
    Buffers(Errno),
    /// The stream cannot be started (`STREAMON`). The usual reason is the USB bandwidth.
    Begin(Errno),
}

/// A streaming device.
#[derive(Debug)]
pub(super) struct Stream {
    device: Device,
    buffers: Vec<Mapped>,
}

impl Stream {
    pub(super) fn device(&self) -> &Device {
        &self.device
    }

    /// Waits until an image is ready (`true`) or the timeout expires. Fails if the device is
    /// disconnected.
    pub(super) fn wait(&self, timeout: Duration) -> rustix::io::Result<bool> {
        let mut poll_fds = [PollFd::new(&self.device.fd, PollFlags::IN)];
        let timeout = Timespec {
            tv_sec: i64::try_from(timeout.as_secs()).unwrap_or(i64::MAX),
            tv_nsec: timeout.subsec_nanos().into(),
        };
        match poll(&mut poll_fds, Some(&timeout)) {
            // The caller compares its deadline and waits again.
            Err(Errno::INTR) => Ok(false),
            Err(error) => Err(error),
            // The result is also `true` after an error, because taking the image then returns the
            // error.
            Ok(_) => Ok(!poll_fds[0].revents().is_empty()),
        }
    }

    /// Takes the oldest filled buffer out of the queue. `None` if no buffer is filled. The caller
    /// must [requeue](Self::requeue) the buffer.
    pub(super) fn take(&mut self) -> rustix::io::Result<Option<FilledBuffer>> {
        let mut buffer = buffer_of(0);
        match self.device.ioctl(&abi::DQBUF, &mut buffer) {
            Ok(()) => {}
            Err(Errno::AGAIN) => return Ok(None),
            Err(error) => return Err(error),
        }
        Ok(Some(FilledBuffer {
            index: buffer.index,
            n_bytes: buffer.bytes_used as usize,
            sequence: buffer.sequence,
            stamp_nanos: buffer
                .secs
                .saturating_mul(1_000_000_000)
                .saturating_add(buffer.micros.saturating_mul(1000)),
            is_monotonic: buffer.flags & abi::BUFFER_CLOCK_MASK == abi::BUFFER_CLOCK_MONOTONIC,
            is_damaged: buffer.flags & abi::BUFFER_ERROR != 0,
        }))
    }

    /// Bytes of a filled buffer, limited to the size of the buffer.
    pub(super) fn bytes(&self, filled: &FilledBuffer) -> &[u8] {
        // An index or length from a faulty driver must not cause a panic.
        let Some(mapping) = self.buffers.get(filled.index as usize) else {
            return &[];
        };
        let buffer_bytes = mapping.bytes();
        &buffer_bytes[..filled.n_bytes.min(buffer_bytes.len())]
    }

    /// Returns a buffer to the device.
    pub(super) fn requeue(&mut self, filled: FilledBuffer) -> rustix::io::Result<()> {
        self.device.ioctl(&abi::QBUF, &mut buffer_of(filled.index))
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        // A disconnected device has already stopped.
        let _ = self
            .device
            .ioctl(&abi::STREAMOFF, &mut abi::VIDEO_CAPTURE.clone());
    }
}

fn buffer_of(index: u32) -> abi::Buffer {
    abi::Buffer {
        index,
        kind: abi::VIDEO_CAPTURE,
        memory: abi::MEMORY_MMAP,
        ..Default::default()
    }
}

/// Memory of an image buffer shared with the kernel.
#[derive(Debug)]
struct Mapped {
    start: *mut c_void,
    n_bytes: usize,
}

// SAFETY: the mapping is owned by this value and may be read from any thread.
#[expect(unsafe_code, reason = "a pointer into shared memory")]
unsafe impl Send for Mapped {}

impl Mapped {
    fn new(fd: impl AsFd, buffer: &abi::Buffer) -> rustix::io::Result<Self> {
        let n_bytes = buffer.length as usize;
        // SAFETY: the kernel chooses the address of this new read-only mapping. The mapping lives
        // until `drop`.
        #[expect(unsafe_code, reason = "system call")]
        let start = unsafe {
            rustix::mm::mmap(
                std::ptr::null_mut(),
                n_bytes,
                ProtFlags::READ,
                MapFlags::SHARED,
                fd,
                u64::from(buffer.offset),
            )?
        };
        Ok(Self { start, n_bytes })
    }

    fn bytes(&self) -> &[u8] {
        // SAFETY: `n_bytes` are mapped for reading as long as this value lives. The device writes
        // only between `QBUF` and `DQBUF`, and `requeue` borrows the stream mutably, so no slice
        // exists then. A device that violates this causes torn pixels: bytes have no invalid
        // values, and nothing here reads the same byte twice to make a decision.
        #[expect(unsafe_code, reason = "memory shared with the kernel")]
        unsafe {
            std::slice::from_raw_parts(self.start.cast::<u8>(), self.n_bytes)
        }
    }
}

impl Drop for Mapped {
    fn drop(&mut self) {
        // SAFETY: `new` mapped the memory with this length. No slice of the memory outlives `self`.
        #[expect(unsafe_code, reason = "system call")]
        let unmapped = unsafe { rustix::mm::munmap(self.start, self.n_bytes) };
        debug_assert!(unmapped.is_ok(), "unmapping failed: {unmapped:?}");
    }
}
