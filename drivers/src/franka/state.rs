//! What a robot's controller tells a thousand times a second, in either version of FCI.

use franka::wire::robot::{v5, v10};
use franka::{FciVersion, RobotState};
use kinematics::{Transform, transform};
use zerocopy::FromBytes;

/// Longer than the longest state, so that one that is too long is seen to be.
pub(super) const MAX_STATE_BYTES: usize = size_of::<v5::RobotState>() + 1;
/// Joints turn less far from zero than this; beyond it a number is noise.
const MAX_RAD: f64 = 10.0;

/// A state, with its number: one more with every millisecond of the robot's clock.
pub(super) struct NumberedState {
    pub(super) number: u64,
    pub(super) state: RobotState,
}

/// Length of a state.
#[cfg(any(test, fuzzing))]
pub(super) fn n_bytes(version: FciVersion) -> usize {
    match version {
        FciVersion::V5 => size_of::<v5::RobotState>(),
        FciVersion::V10 => size_of::<v10::RobotState>(),
    }
}

/// Reads a datagram; `None` where it is none of that version, or its joints are no angles.
pub(super) fn decode(version: FciVersion, bytes: &[u8]) -> Option<NumberedState> {
    let (number, state) = match version {
        FciVersion::V5 => {
            let wire = v5::RobotState::read_from_bytes(bytes).ok()?;
            (wire.message_id.get(), RobotState::from_wire_v5(&wire))
        }
        FciVersion::V10 => {
            let wire = v10::RobotState::read_from_bytes(bytes).ok()?;
            (wire.message_id.get(), RobotState::from_wire(&wire))
        }
    };
    let are_angles = state.q.iter().all(|angle| angle.abs() <= MAX_RAD);
    let are_numbers = state.dq.iter().chain(&state.tau_J).all(|number| number.is_finite());
    (are_angles && are_numbers).then_some(NumberedState { number, state })
}

/// A pose that is told as a 4x4 matrix, column major.
pub(super) fn pose(columns: &[f64; 16]) -> Result<Transform, kinematics::Error> {
    transform::from_rows(&std::array::from_fn(|at| columns[(at % 4) * 4 + at / 4]))
}

/// The matrix of a pose, column major.
pub(super) fn columns(pose: &Transform) -> [f64; 16] {
    let rows = transform::to_rows(pose);
    std::array::from_fn(|at| rows[(at % 4) * 4 + at / 4])
}
