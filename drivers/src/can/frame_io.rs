//! Access to a bus as plain frames and counters of errors, independent of the operating system.

use crate::Error;
use crate::wire::can::Frame;
use kinematics::Stamp;
use std::time::Duration;

/// Sends and receives frames.
pub trait FrameIo {
    /// Name of the interface.
    fn interface(&self) -> &str;
    /// Sends a frame. Returns whether it was accepted. It is not accepted if the interface's queue
    /// stays full.
    fn send(&self, frame: &Frame) -> Result<bool, Error>;
    /// Waits for the next event. Returns `None` if there was none within the timeout.
    fn receive(&self, timeout: Duration) -> Result<Option<(Stamp, BusEvent)>, Error>;
}

/// Something received from the bus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BusEvent {
    /// A frame from another node.
    Frame(Frame),
    /// Errors on the wire, reported by the controller.
    Errors(WireErrors),
}

/// Counters of error frames. One error frame may report several errors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WireErrors {
    /// Number of error frames.
    pub n_frames: u64,
    /// Number of times the controller went bus-off.
    pub n_bus_off: u64,
    /// Number of times the controller restarted.
    pub n_restarts: u64,
    /// Number of times an error counter reached the warning level of 96.
    pub n_warnings: u64,
    /// Number of times the controller became error-passive, at a counter of 128.
    pub n_passive: u64,
    /// Number of frames that no node acknowledged. The bus then has no other node, or none with
    /// this bit rate.
    pub n_unacknowledged: u64,
    /// Number of times a buffer of the controller or the kernel was full, so that frames were
    /// dropped.
    pub n_overflows: u64,
}

impl WireErrors {
    /// Adds the counters of `other`.
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
        let Self {
            n_frames,
            n_bus_off,
            n_restarts,
            n_warnings,
            n_passive,
            n_unacknowledged,
            n_overflows,
        } = self;
        let bus_offs = if *n_bus_off == 1 {
            "bus-off"
        } else {
            "bus-offs"
        };
        write!(
            f,
            "{n_bus_off} {bus_offs}, {n_restarts} restarts; {n_warnings} warnings, {n_passive} passive, \
             {n_unacknowledged} frames not acknowledged, {n_overflows} overflows; {n_frames} error frames in total"
        )
    }
}
