//! Joint positions, velocities or efforts of an arm with any number of joints.

use nalgebra::DVector;

/// One value per joint of the arm, from base to flange: radians or meters, the same per second, or
/// newton meters or newtons.
pub(crate) type Joints = DVector<f64>;
