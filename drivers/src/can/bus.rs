//! One CAN bus: sends frames, and receives frames and errors with the kernel's time stamps.

use super::config::BusConfig;
use super::frame_io::{BusEvent, FrameIo, WireErrors};
use super::link::Link;
use crate::wire::can::frame::Stuffing;
use crate::wire::can::{Frame, Id};
use crate::{Error, clock};
use kinematics::Stamp;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use socketcan::{
    CanAnyFrame, CanDataFrame, CanErrorFrame, CanFdFrame, CanFdSocket, CanRemoteFrame,
    EmbeddedFrame, ExtendedId, Id as SocketId, ShouldRetry, Socket, SocketOptions, StandardId,
    errors::ControllerProblems,
};
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Maximum time for which sending is retried while the interface's queue is full. A queue of ten
/// frames empties in 1.4 ms at 1 Mbit/s, and in 11 ms at 125 kbit/s, if frames are acknowledged.
pub(super) const MAX_SENDING: Duration = Duration::from_millis(20);
/// `errno` for "no buffer space": the interface's queue is full.
const ENOBUFS: i32 = 105;

/// An open bus. Dropping it closes the socket and does not change the interface.
#[derive(Debug)]
pub struct Bus {
    config: BusConfig,
    socket: CanFdSocket,
    /// Total duration of all frames on the bus, our own included, in nanoseconds.
    busy_nanos: AtomicU64,
}

impl Bus {
    /// Opens an interface and checks that it is set up as in `config`.
    ///
    /// # Errors
    /// If the interface is not set up as in `config`. The error contains the command that sets it
    /// up.
    pub fn open(config: &BusConfig) -> Result<Self, Error> {
        // A wrong bit rate would disturb every node on the bus, so the interface is checked before
        // the socket exists.
        Link::read(&config.interface)?.check(config)?;
        let open = CanFdSocket::open(&config.interface).and_then(|socket| {
            // Error frames are off by default. They distinguish an unpowered motor from an
            // interrupted bus.
            socket.set_error_filter_accept_all()?;
            // The kernel's stamps do not depend on when this thread is scheduled.
            socket.set_recv_timestamp(true)?;
            // All waits use `poll`, which has a better resolution and can wait for several buses.
            socket.set_nonblocking(true)?;
            Ok(socket)
        });
        let socket = open.map_err(|reason| Error::CanBus {
            interface: config.interface.clone(),
            reason,
        })?;
        Ok(Self {
            config: config.clone(),
            socket,
            busy_nanos: AtomicU64::new(0),
        })
    }

    /// The configuration with which the bus was opened.
    pub fn config(&self) -> &BusConfig {
        &self.config
    }

    /// Total duration of the frames since the bus was opened, without error frames and stuff bits.
    pub fn busy(&self) -> Duration {
        Duration::from_nanos(self.busy_nanos.load(Ordering::Relaxed))
    }

    /// Sends a frame, and waits briefly while the interface's queue is full. Returns whether the
    /// kernel accepted the frame.
    ///
    /// The result is `false` if the queue stayed full. The queue stays full if no node acknowledges
    /// frames. The result `true` does not mean that the frame was sent. While the controller is
    /// bus-off, the kernel accepts frames and drops them.
    pub fn send(&self, frame: &Frame) -> Result<bool, Error> {
        self.send_within(frame, MAX_SENDING)
    }

    /// Like [`Bus::send`], but waits at most `bound`. Use it for frames that are valid only now.
    pub fn send_within(&self, frame: &Frame, bound: Duration) -> Result<bool, Error> {
        let start = clock::now();
        loop {
            match self.write(frame) {
                Ok(()) => {
                    self.count(frame);
                    return Ok(true);
                }
                Err(error) if error.raw_os_error() == Some(ENOBUFS) || error.should_retry() => {
                    if clock::now().duration_since(start) >= bound {
                        return Ok(false);
                    }
                    // A classic frame takes up to 135 us at 1 Mbit/s, so one or two slots become
                    // free in this time. The kernel does not report when a slot becomes free,
                    // because a CAN socket counts as writable even while the queue is full.
                    std::thread::sleep(Duration::from_micros(200));
                }
                Err(source) => return Err(self.bus_error(source)),
            }
        }
    }

    fn write(&self, frame: &Frame) -> io::Result<()> {
        let id = socket_id(frame.id());
        let invalid = || io::Error::from(io::ErrorKind::InvalidInput);
        if frame.is_remote() {
            let socket_frame =
                CanRemoteFrame::new_remote(id, frame.n_bytes()).ok_or_else(invalid)?;
            return self.socket.write_frame(&socket_frame);
        }
        // The type of the socket frame determines the format on the wire. A classic-only node
        // answers an FD frame with error frames.
        if frame.is_fd() {
            let mut socket_frame = CanFdFrame::new(id, frame.data()).ok_or_else(invalid)?;
            socket_frame.set_brs(frame.is_switched());
            return self.socket.write_frame(&socket_frame);
        }
        self.socket
            .write_frame(&CanDataFrame::new(id, frame.data()).ok_or_else(invalid)?)
    }

    /// Waits until one of the buses has received something, or the timeout expires.
    pub fn wait_for_any(buses: &[Self], timeout: Duration) {
        let mut polled: Vec<_> = buses
            .iter()
            .map(|bus| PollFd::new(&bus.socket, PollFlags::IN))
            .collect();
        // Errors are reported when the bus is read.
        let _ = poll(&mut polled, Some(&timespec(timeout)));
    }

    /// Waits for the next event. Returns `None` if there was none within the timeout.
    pub fn receive(&self, timeout: Duration) -> Result<Option<(Stamp, BusEvent)>, Error> {
        // The resolution of the socket's receive timeout is one tick of the kernel (up to 10 ms).
        // `ppoll` has a higher resolution.
        match poll(
            &mut [PollFd::new(&self.socket, PollFlags::IN)],
            Some(&timespec(timeout)),
        ) {
            // A signal ends the wait early. The caller waits again if it has time left.
            Ok(0) | Err(Errno::INTR) => return Ok(None),
            Ok(_) => {}
            Err(error) => return Err(self.bus_error(error.into())),
        }
        let (frame, at) = match self.socket.read_frame_with_timestamp() {
            Ok(read) => read,
            Err(error) if error.should_retry() => return Ok(None),
            Err(source) => return Err(self.bus_error(source)),
        };
        let now = clock::now();
        // The kernel stamps frames with the wall clock. The age of the frame is used to convert the
        // stamp to our clock.
        let stamp = at.elapsed().map_or(now, |age| now - age);
        let frame = match frame {
            CanAnyFrame::Error(error) => {
                return Ok(Some((stamp, BusEvent::Errors(wire_errors(error)))));
            }
            CanAnyFrame::Normal(frame) => Frame::classic(id_of(&frame), frame.data()),
            CanAnyFrame::Remote(frame) => Frame::remote(id_of(&frame), frame.dlc()),
            CanAnyFrame::Fd(frame) => Frame::fd(id_of(&frame), frame.data(), frame.is_brs()),
        };
        let frame = frame.map_err(|error| self.bus_error(io::Error::other(error.to_string())))?;
        self.count(&frame);
        Ok(Some((stamp, BusEvent::Frame(frame))))
    }

    /// Adds the duration of a frame to the load.
    fn count(&self, frame: &Frame) {
        let busy = Duration::from_secs_f64(frame.bits(Stuffing::None).seconds(self.config.rates()));
        let nanos = u64::try_from(busy.as_nanos()).unwrap_or(u64::MAX);
        // No other memory access depends on the order of this counter's updates.
        self.busy_nanos.fetch_add(nanos, Ordering::Relaxed);
    }

    fn bus_error(&self, reason: io::Error) -> Error {
        Error::CanBus {
            interface: self.config.interface.clone(),
            reason,
        }
    }
}

impl FrameIo for Bus {
    fn interface(&self) -> &str {
        &self.config.interface
    }

    fn send(&self, frame: &Frame) -> Result<bool, Error> {
        Self::send(self, frame)
    }

    fn receive(&self, timeout: Duration) -> Result<Option<(Stamp, BusEvent)>, Error> {
        Self::receive(self, timeout)
    }
}

/// Counts the errors that an error frame reports.
fn wire_errors(frame: CanErrorFrame) -> WireErrors {
    let error = frame.into_error();
    let problems = error.controller();
    let has = |problem| problems.is_some_and(|problems| problems.contains(problem));
    WireErrors {
        n_frames: 1,
        n_bus_off: error.is_bus_off().into(),
        n_restarts: error.is_restarted().into(),
        n_warnings: (has(ControllerProblems::RX_WARNING) || has(ControllerProblems::TX_WARNING))
            .into(),
        n_passive: (has(ControllerProblems::RX_PASSIVE) || has(ControllerProblems::TX_PASSIVE))
            .into(),
        n_unacknowledged: error.is_no_ack().into(),
        n_overflows: (has(ControllerProblems::RX_OVERFLOW) || has(ControllerProblems::TX_OVERFLOW))
            .into(),
    }
}

fn timespec(timeout: Duration) -> Timespec {
    Timespec {
        tv_sec: i64::try_from(timeout.as_secs()).unwrap_or(i64::MAX),
        tv_nsec: timeout.subsec_nanos().into(),
    }
}

fn socket_id(id: Id) -> SocketId {
    if id.is_extended() {
        SocketId::Extended(ExtendedId::new(id.value()).expect("an extended ID has at most 29 bits"))
    } else {
        let value = u16::try_from(id.value()).expect("a standard ID has at most 11 bits");
        SocketId::Standard(StandardId::new(value).expect("a standard ID has at most 11 bits"))
    }
}

fn id_of(frame: &impl EmbeddedFrame) -> Id {
    match frame.id() {
        SocketId::Standard(id) => Id::standard(id.as_raw().into()),
        SocketId::Extended(id) => Id::extended(id.as_raw()),
    }
    .expect("identifiers have 11 or 29 bits")
}
