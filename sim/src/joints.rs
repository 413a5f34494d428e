//! Joint positions, velocities or efforts of an arm with any number of joints.

use nalgebra::DVector;

/// One value per joint of the arm, from base to flange. Positions are in radians or meters,
/// velocities are in the same units per second, and efforts are in newton meters or newtons.
pub(crate) type Joints = DVector<f64>;
