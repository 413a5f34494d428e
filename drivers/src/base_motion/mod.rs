//! Bases that may be driven: velocities that expire, their limits, and the thread that passes them
//! to the base.
//!
//! A program sends targets through a [`BasePort`]. The thread of the base ([`BaseDrive`]) turns
//! them into velocities within the limits ([`BaseFollower`]), and brakes as soon as a target
//! expires, whatever happens to the rest of the program.

mod drive;
mod follower;
mod limits;
mod port;
mod target;
#[cfg(test)]
mod tests;
mod velocity;

pub use drive::BaseDrive;
pub use follower::BaseFollower;
pub use limits::BaseLimits;
pub use port::BasePort;
pub use target::{BaseOutput, BaseState, BaseTarget};
pub use velocity::BaseVelocity;

use crate::Error;
use kinematics::Stamp;

/// A base that can also be driven.
///
/// The owner of this trait object may move the base. Programs that only read its pose use a
/// [`Base`](crate::Base).
pub trait MovableBase: Send {
    /// Sets the velocity until the next call. The thread of the base calls this every 20 ms, also
    /// while the base is at rest. A base must stop if the calls end.
    ///
    /// * `velocity`: within the limits of the base. Zero means that the base must stand still.
    ///
    /// # Errors
    /// If the base cannot be reached from this computer. The next call tries again.
    fn drive(&mut self, now: Stamp, velocity: &BaseVelocity) -> Result<(), Error>;

    /// The newest report of the base.
    fn report(&mut self, now: Stamp) -> BaseReport;
}

/// Report of a base.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BaseReport {
    /// When the newest report arrived; `None` before the first.
    pub reported_at: Option<Stamp>,
    /// Measured velocity.
    pub velocity: BaseVelocity,
    /// Whether the base has confirmed the command to stand still.
    pub is_stop_confirmed: bool,
    /// Whether the base still moves without commands, as a simulated base does on its tour. It then
    /// ignores velocities.
    pub is_on_tour: bool,
    /// Why the base cannot move, if it reports a fault.
    pub fault: Option<String>,
    /// Why the base refused the newest velocity, if it did.
    pub refusal: Option<String>,
}
