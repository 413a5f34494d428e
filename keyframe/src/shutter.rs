//! Rolling shutters.

use kinematics::Twist;

/// Motion of a camera with a rolling shutter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shutter {
    /// Velocity of the camera in its own axes.
    pub twist: Twist,
    /// Time from the first row's exposure to the last row's, seconds.
    pub readout_secs: f64,
}
