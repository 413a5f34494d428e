//! Emulates servos on a serial bus. They follow a script until a client enables one of them.

use super::JointTrack;
use drivers::Error;
use drivers::servos::emulated::{EmulatedServo, EmulatedServoBus, ServoKind};
use drivers::servos::{ServoArmConfig, ServoConfig};
use std::f64::consts::TAU;

/// Counts per revolution of a servo.
const COUNTS_PER_TURN: f64 = 4096.0;

/// Emulates the servos of an arm at the path of its port, which becomes a symbolic link to a pseudo
/// terminal. The track's joints are in the order of the servos. Once a client has enabled a servo,
/// all servos follow only client commands.
pub fn emulate_servos(
    track: JointTrack,
    config: &ServoArmConfig,
    kind: ServoKind,
) -> Result<EmulatedServoBus, Error> {
    let joints = config.servos.clone();
    let new = |servo: &ServoConfig| EmulatedServo::new(kind, servo.id, servo.zero_counts);
    let servos = joints.iter().map(new).collect();
    let mut is_client_controlled = false;
    EmulatedServoBus::start(kind, servos, &config.port.device, move |now, servos| {
        // A script that moves some joints would interfere with the client.
        if servos.iter().any(EmulatedServo::is_enabled) && !is_client_controlled {
            is_client_controlled = true;
            log::info!("a client controls the arm: it no longer follows the script");
        }
        if is_client_controlled {
            return;
        }
        let state = track.at(now);
        for (ix, (servo, joint)) in servos.iter_mut().zip(&joints).enumerate() {
            // This is the inverse of the conversion in the driver.
            let direction = if joint.is_reversed { -1.0 } else { 1.0 };
            let counts_per_rad = direction * joint.gear_ratio * COUNTS_PER_TURN / TAU;
            let of = |numbers: &[f64]| numbers.get(ix).copied().unwrap_or(0.0) * counts_per_rad;
            servo.set_motion(
                f64::from(joint.zero_counts) + of(&state.position),
                of(&state.velocity),
            );
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivers::Arm;
    use drivers::can::FollowingLimits;
    use drivers::servos::{DynamixelProtocol, FeetechProtocol, PortConfig, ServoArm};
    use std::time::Duration;

    /// Time limit, which is reached only if the test fails.
    const LIMIT: Duration = Duration::from_secs(60);

    #[test]
    fn driver_reads_the_positions_of_the_script() {
        let folder = tempfile::tempdir().expect("a folder");
        let position = vec![0.5, -1.2];
        let servo = |id: u8, is_reversed| ServoConfig {
            joint: format!("joint{id}"),
            id,
            zero_counts: 2100,
            is_reversed,
            gear_ratio: f64::from(id),
            following: FollowingLimits::default(),
        };
        for kind in [ServoKind::Feetech, ServoKind::Dynamixel] {
            let config = ServoArmConfig {
                protocol: match kind {
                    ServoKind::Feetech => &FeetechProtocol,
                    ServoKind::Dynamixel => &DynamixelProtocol,
                },
                port: PortConfig {
                    device: folder.path().join("arm"),
                    baud_hz: 1_000_000,
                    reconnect_for: LIMIT,
                    max_answer_delay: LIMIT,
                },
                servos: vec![servo(1, false), servo(2, true)],
                rate_hz: 200.0,
            };
            let track = JointTrack::at_rest(position.clone()).expect("two joints");
            let _bus = emulate_servos(track, &config, kind).expect("a pseudo terminal");
            let mut arm = ServoArm::open(&config).expect("two servos");
            let state = arm.read(LIMIT).expect("a state");
            for (got, expected) in state.position.iter().zip(&position) {
                // The tolerance is half a count.
                assert!((got - expected).abs() <= TAU / 8192.0 + 1e-9, "{state:?}");
            }
        }
    }
}
