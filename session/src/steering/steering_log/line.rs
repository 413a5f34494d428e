//! The lines of a steering log.

use drivers::motion::exact;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};
use steering::{Entry, Setup};

/// Version of the format. Logs of other versions are refused, because their replay would differ.
pub(in crate::steering) const VERSION: u64 = 2;

/// One line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(in crate::steering) enum Line {
    /// The first line, and the first one after missing entries: the chain of decisions with its
    /// state.
    Start(Box<Start>),
    /// A request or a cycle.
    Entry(Box<Entry>),
    /// New view of the holder of the lease.
    View(View),
    /// Entries are missing here, because the disk was too slow.
    Missing(u64),
    /// The log is complete.
    End(Moment),
}

/// Setup for all further lines.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::steering) struct Start {
    /// [`VERSION`].
    pub(in crate::steering) version: u64,
    /// Version and processor of the program.
    pub(in crate::steering) program: String,
    /// Now on the clock of the entries.
    #[serde(with = "exact::stamp")]
    pub(in crate::steering) at: Stamp,
    /// The same moment on the wall clock, milliseconds since 1970.
    pub(in crate::steering) unix_millis: u64,
    /// Pose of the base of the arm, unless the base is steered: x, y, z in meters, and a quaternion
    /// x, y, z, w.
    pub(in crate::steering) world_from_base: [f64; 7],
    /// Configuration, robot, limits and state.
    pub(in crate::steering) setup: Setup,
}

/// A time on the clock of the entries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::steering) struct Moment {
    /// The time.
    #[serde(with = "exact::stamp")]
    pub(in crate::steering) at: Stamp,
}

/// The pose of an operator's eye.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(in crate::steering) struct View {
    /// When it arrived.
    #[serde(with = "exact::stamp")]
    pub(in crate::steering) at: Stamp,
    /// Number of the operator.
    pub(in crate::steering) operator: u64,
    /// x, y, z in meters, and a quaternion x, y, z, w; the camera is x right, y down, z forward.
    pub(in crate::steering) world_from_camera: [f64; 7],
}
