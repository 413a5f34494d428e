//! Decodes the states that a controller sends at 1 kHz, in both versions of FCI.

use franka::wire::robot::{v5, v10};
use franka::{FciVersion, RobotState};
use kinematics::{Transform, transform};
use zerocopy::FromBytes;

/// One byte more than the longest state, so that datagrams that are too long are detected.
pub(super) const MAX_STATE_BYTES: usize = size_of::<v5::RobotState>() + 1;
/// Maximum angle of any joint. States with larger angles are invalid. All joints of both robots
/// stay within 5 rad, so the value only excludes corrupted states.
const MAX_RAD: f64 = 10.0;

/// A state with its number, which increases by one per millisecond of the robot's clock.
pub(super) struct NumberedState {
    pub(super) number: u64,
    pub(super) state: RobotState,
}

/// Length of a state in bytes.
#[cfg(any(test, fuzzing))]
pub(super) fn n_bytes(version: FciVersion) -> usize {
    match version {
        FciVersion::V5 => size_of::<v5::RobotState>(),
        FciVersion::V10 => size_of::<v10::RobotState>(),
    }
}

/// Decodes a datagram. `None` if the datagram is not a state of this version, or if its numbers are
/// implausible.
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
    // Datagrams have no checksum beside that of UDP. A corrupted angle would give an image a wrong
    // pose, so implausible states are dropped. NaN fails the comparison.
    let are_angles = state.q.iter().all(|angle| angle.abs() <= MAX_RAD);
    let are_numbers = state
        .dq
        .iter()
        .chain(&state.tau_J)
        .all(|number| number.is_finite());
    (are_angles && are_numbers).then_some(NumberedState { number, state })
}

/// Decodes a pose from a 4x4 matrix in column-major order.
pub(super) fn pose(columns: &[f64; 16]) -> Result<Transform, kinematics::Error> {
    transform::from_rows(&std::array::from_fn(|at| columns[(at % 4) * 4 + at / 4]))
}
