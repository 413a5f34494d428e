//! Frames on the buses of an arm with a motor of each family; the seeds of the fuzz target.

use super::{FD_LENGTHS, motors};
use crate::can::config::MotorConfig;
use crate::can::emulated::EmulatedMotor;
use crate::can::family::{FamilyFuzzing, LIMITS};
use crate::can::motor::{Motor, Reading};
use crate::wire::can::mit::Motion;
use crate::wire::can::{Frame, canopen};
use kinematics::Stamp;
use std::time::Duration;

/// Encodes frames in the format of [`super::decode_frames`].
pub(crate) fn encode_frames(frames: &[Frame]) -> Vec<u8> {
    frames.iter().flat_map(encode_frame).collect()
}

fn encode_frame(frame: &Frame) -> Vec<u8> {
    let n = frame.n_bytes();
    // A DLC (data length code) above 8 is an index into the lengths of FD frames.
    let code = if n <= 8 {
        n
    } else {
        9 + FD_LENGTHS
            .iter()
            .position(|len| *len == n)
            .expect("an FD length")
    };
    let flag = |condition: bool, bit: u8| if condition { bit } else { 0 };
    let head = u8::try_from(code).expect("small")
        | flag(frame.id().is_extended(), 0x10)
        | flag(frame.is_remote(), 0x20)
        | flag(frame.is_fd(), 0x40)
        | flag(frame.is_switched(), 0x80);
    [&[head][..], &frame.id().value().to_le_bytes(), frame.data()].concat()
}

/// All frames on the buses while an arm is set up and read for some cycles.
pub(crate) fn example_traffic() -> Vec<Frame> {
    record_traffic()
        .into_iter()
        .flat_map(|(sent_frames, _)| sent_frames)
        .collect()
}

/// For each motor, the frames on its bus and the readings that they contain.
pub(super) fn record_traffic() -> Vec<(Vec<Frame>, Vec<Reading>)> {
    motors()
        .into_iter()
        .map(|config| record_traffic_of(&config))
        .collect()
}

fn record_traffic_of(config: &MotorConfig) -> (Vec<Frame>, Vec<Reading>) {
    let mut emulated = EmulatedMotor::new(&*config.protocol, LIMITS);
    let listeners = Motor::with_limits(config.clone(), LIMITS);
    let mut sent_frames = fuzzing(config).set_up;
    let mut expected_readings = Vec::new();
    for frame in sent_frames.clone() {
        sent_frames.extend(emulated.take(&frame).expect("a frame of the driver"));
    }
    for cycle in 0..6_u16 {
        // The position differs in each cycle, so that tests can identify the reading that a
        // corrupted frame came from.
        emulated.set_motion(Motion {
            position_rad: 0.4 * f64::from(cycle),
            velocity_rad_s: 0.5,
            torque_nm: -0.25,
        });
        let mut poll_frames: Vec<Frame> = config.protocol.poll_frame().into_iter().collect();
        poll_frames.extend(
            config
                .protocol
                .canopen_node()
                .map(|_| canopen::encode_sync()),
        );
        // In a real setup, another master commands some motors; here, the test commands them.
        poll_frames.extend(fuzzing(config).other_master);
        let mut answers: Vec<Frame> = poll_frames
            .iter()
            .flat_map(|frame| emulated.take(frame).expect("a frame of the driver"))
            .collect();
        answers.extend(
            emulated
                .report(Stamp(0) + Duration::from_millis(20) * u32::from(cycle))
                .expect("the motion is in range"),
        );
        expected_readings.extend(answers.iter().filter_map(|frame| listeners.read(frame)));
        sent_frames.extend(poll_frames);
        sent_frames.extend(answers);
    }
    (sent_frames, expected_readings)
}

pub(super) fn fuzzing(config: &MotorConfig) -> FamilyFuzzing {
    config.protocol.family().fuzzing()
}
