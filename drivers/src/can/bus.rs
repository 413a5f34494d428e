//! One CAN bus: frames out, frames and errors in, each stamped as the kernel got it.

use super::config::BusConfig;
use super::link::Link;
use crate::wire::can::frame::Stuffing;
use crate::wire::can::{Frame, Id};
use crate::{Error, clock};
use kinematics::Stamp;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use socketcan::{
    CanAnyFrame, CanDataFrame, CanErrorFrame, CanFdFrame, CanFdSocket, CanRemoteFrame, EmbeddedFrame, ExtendedId,
    Id as SocketId, ShouldRetry, Socket, SocketOptions, StandardId, errors::ControllerProblems,
};
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// A frame that found no room in the interface's queue is tried again for so long.
const MAX_SENDING: Duration = Duration::from_millis(20);
/// The system's number for "no buffer space": the interface's queue is full.
const ENOBUFS: i32 = 105;

/// What came.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BusEvent {
    /// A frame of somebody else.
    Frame(Frame),
    /// The controller tells of errors on the wire.
    Errors(WireErrors),
}

/// What error frames told, counted; one frame may tell several.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WireErrors {
    /// Error frames.
    pub n_frames: u64,
    /// The controller went off the bus.
    pub n_bus_off: u64,
    /// It came back.
    pub n_restarts: u64,
    /// It passed the mark of 96 errors.
    pub n_warnings: u64,
    /// It passed the mark of 128 errors.
    pub n_passive: u64,
    /// Nobody acknowledged a frame: there is no one else, or no one at this bit rate.
    pub n_unacknowledged: u64,
    /// Frames that the controller or the kernel had no room for.
    pub n_overflows: u64,
}

impl WireErrors {
    fn of(frame: CanErrorFrame) -> Self {
        let error = frame.into_error();
        let problems = error.controller();
        let has = |problem| problems.is_some_and(|problems| problems.contains(problem));
        Self {
            n_frames: 1,
            n_bus_off: error.is_bus_off().into(),
            n_restarts: error.is_restarted().into(),
            n_warnings: (has(ControllerProblems::RX_WARNING) || has(ControllerProblems::TX_WARNING)).into(),
            n_passive: (has(ControllerProblems::RX_PASSIVE) || has(ControllerProblems::TX_PASSIVE)).into(),
            n_unacknowledged: error.is_no_ack().into(),
            n_overflows: (has(ControllerProblems::RX_OVERFLOW) || has(ControllerProblems::TX_OVERFLOW)).into(),
        }
    }

    /// Adds what another one counted.
    pub fn add(&mut self, other: &Self) {
        self.n_frames += other.n_frames;
        self.n_bus_off += other.n_bus_off;
        self.n_restarts += other.n_restarts;
        self.n_warnings += other.n_warnings;
        self.n_passive += other.n_passive;
        self.n_unacknowledged += other.n_unacknowledged;
        self.n_overflows += other.n_overflows;
    }
}

impl std::fmt::Display for WireErrors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { n_frames, n_bus_off, n_restarts, n_warnings, n_passive, n_unacknowledged, n_overflows } = self;
        let times = if *n_bus_off == 1 { "time" } else { "times" };
        write!(
            f,
            "{n_bus_off} {times} off the bus, {n_restarts} back; {n_warnings} warnings, {n_passive} passive, \
             {n_unacknowledged} frames not acknowledged, {n_overflows} overflows; {n_frames} error frames in all"
        )
    }
}

/// An open bus. Dropping it closes the socket; the interface stays as it is.
#[derive(Debug)]
pub struct Bus {
    config: BusConfig,
    socket: CanFdSocket,
    /// How long frames kept the bus busy, those of others and our own, nanoseconds.
    busy_nanos: AtomicU64,
}

impl Bus {
    /// Opens an interface that is set up as `config` wants it; where it is not, the error names the command that mends it.
    pub fn open(config: &BusConfig) -> Result<Self, Error> {
        Link::read(&config.interface)?.check(config)?;
        let open = CanFdSocket::open(&config.interface).and_then(|socket| {
            socket.set_error_filter_accept_all()?;
            socket.set_recv_timestamp(true)?;
            socket.set_nonblocking(true)?;
            Ok(socket)
        });
        let socket = open.map_err(|reason| Error::CanBus { interface: config.interface.clone(), reason })?;
        Ok(Self { config: config.clone(), socket, busy_nanos: AtomicU64::new(0) })
    }

    /// How it was opened.
    pub fn config(&self) -> &BusConfig {
        &self.config
    }

    /// How long frames have kept the bus busy since it was opened, errors and stuff bits left out.
    pub fn busy(&self) -> Duration {
        Duration::from_nanos(self.busy_nanos.load(Ordering::Relaxed))
    }

    /// Sends a frame; waits a moment where the interface's queue is full. False where it stayed full, as it does while nobody
    /// acknowledges. True says no more than that the kernel took it: those for a controller that is off the bus it takes and drops.
    pub fn send(&self, frame: &Frame) -> Result<bool, Error> {
        self.send_within(frame, MAX_SENDING)
    }

    /// The same, with another bound: what is of this instant only must not wait.
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
            let socket_frame = CanRemoteFrame::new_remote(id, frame.n_bytes()).ok_or_else(invalid)?;
            return self.socket.write_frame(&socket_frame);
        }
        if frame.is_fd() {
            let mut socket_frame = CanFdFrame::new(id, frame.data()).ok_or_else(invalid)?;
            socket_frame.set_brs(frame.is_switched());
            return self.socket.write_frame(&socket_frame);
        }
        self.socket.write_frame(&CanDataFrame::new(id, frame.data()).ok_or_else(invalid)?)
    }

    /// Waits until something came on any of them, or the time is over.
    pub fn wait_for_any(buses: &[Self], timeout: Duration) {
        let mut polled: Vec<_> = buses.iter().map(|bus| PollFd::new(&bus.socket, PollFlags::IN)).collect();
        // What is wrong with a bus is told where it is read.
        let _ = poll(&mut polled, Some(&timespec(timeout)));
    }

    /// Waits for what comes next; `None` where nothing came.
    pub fn receive(&self, timeout: Duration) -> Result<Option<(Stamp, BusEvent)>, Error> {
        // A receive timeout of the socket counts in jiffies, up to 10 ms each; that of ppoll is fine.
        match poll(&mut [PollFd::new(&self.socket, PollFlags::IN)], Some(&timespec(timeout))) {
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
        // The kernel's stamp is of the wall clock; how long ago it was is the same on ours.
        let stamp = at.elapsed().map_or(now, |age| now - age);
        let frame = match frame {
            CanAnyFrame::Error(error) => return Ok(Some((stamp, BusEvent::Errors(WireErrors::of(error))))),
            CanAnyFrame::Normal(frame) => Frame::classic(id_of(&frame), frame.data()),
            CanAnyFrame::Remote(frame) => Frame::remote(id_of(&frame), frame.dlc()),
            CanAnyFrame::Fd(frame) => Frame::fd(id_of(&frame), frame.data(), frame.is_brs()),
        };
        let frame = frame.map_err(|error| self.bus_error(io::Error::other(error.to_string())))?;
        self.count(&frame);
        Ok(Some((stamp, BusEvent::Frame(frame))))
    }

    fn count(&self, frame: &Frame) {
        let busy = Duration::from_secs_f64(frame.bits(Stuffing::None).seconds(self.config.rates()));
        let nanos = u64::try_from(busy.as_nanos()).unwrap_or(u64::MAX);
        self.busy_nanos.fetch_add(nanos, Ordering::Relaxed);
    }

    fn bus_error(&self, reason: io::Error) -> Error {
        Error::CanBus { interface: self.config.interface.clone(), reason }
    }
}

fn timespec(timeout: Duration) -> Timespec {
    Timespec { tv_sec: i64::try_from(timeout.as_secs()).unwrap_or(i64::MAX), tv_nsec: timeout.subsec_nanos().into() }
}

fn socket_id(id: Id) -> SocketId {
    match id.is_extended() {
        true => SocketId::Extended(ExtendedId::new(id.value()).expect("29 bits by its making")),
        false => {
            let value = u16::try_from(id.value()).expect("11 bits by its making");
            SocketId::Standard(StandardId::new(value).expect("11 bits by its making"))
        }
    }
}

fn id_of(frame: &impl EmbeddedFrame) -> Id {
    match frame.id() {
        SocketId::Standard(id) => Id::standard(id.as_raw().into()),
        SocketId::Extended(id) => Id::extended(id.as_raw()),
    }
    .expect("identifiers have 11 or 29 bits")
}
