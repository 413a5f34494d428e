//! Rolling shutters.

use kinematics::Twist;

/// Motion of a camera with a rolling shutter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shutter {
    /// Velocity of the camera in its own axes.
    pub twist: Twist,
    /// Time from the exposure of the first row to the exposure of the last row, seconds.
    pub readout_secs: f64,
}
