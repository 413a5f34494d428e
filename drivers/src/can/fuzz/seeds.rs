//! Frames on the buses of an arm with a motor of each family; the seeds of the fuzz target.

use super::{FD_LENGTHS, LIMITS, motors};
use crate::can::ROBSTRIDE_HOST;
use crate::can::config::{Family, MotorConfig};
use crate::can::emulated::EmulatedMotor;
use crate::can::motor::{Motor, Reading};
use crate::wire::can::mit::Motion;
use crate::wire::can::{Frame, Id, canopen, cia402, damiao, robstride};
use kinematics::Stamp;
use std::time::Duration;

/// Encodes frames in the format of [`super::decode_frames`].
pub(crate) fn encode_frames(frames: &[Frame]) -> Vec<u8> {
    let encode = |frame: &Frame| {
        let n = frame.n_bytes();
        let code = if n <= 8 { n } else { 9 + FD_LENGTHS.iter().position(|len| *len == n).expect("an FD length") };
        let flag = |condition: bool, bit: u8| if condition { bit } else { 0 };
        let head = u8::try_from(code).expect("small")
            | flag(frame.id().is_extended(), 0x10)
            | flag(frame.is_remote(), 0x20)
            | flag(frame.is_fd(), 0x40)
            | flag(frame.is_switched(), 0x80);
        [&[head][..], &frame.id().value().to_le_bytes(), frame.data()].concat()
    };
    frames.iter().flat_map(encode).collect()
}

/// All frames on the buses while an arm is set up and read for some cycles.
pub(crate) fn example_traffic() -> Vec<Frame> {
    record_traffic().into_iter().flat_map(|(sent_frames, _)| sent_frames).collect()
}

/// For each motor: the frames on its bus, and the readings that they contain.
pub(super) fn record_traffic() -> Vec<(Vec<Frame>, Vec<Reading>)> {
    motors().into_iter().map(|config| record_traffic_of(&config)).collect()
}

fn record_traffic_of(config: &MotorConfig) -> (Vec<Frame>, Vec<Reading>) {
    let mut emulated = EmulatedMotor::new(config.family, LIMITS);
    let listeners = Motor::with_limits(config.clone(), LIMITS);
    let (mut sent_frames, mut expected_readings) = (set_up(config), Vec::new());
    for frame in sent_frames.clone() {
        sent_frames.extend(emulated.take(&frame).expect("a frame of the driver"));
    }
    for cycle in 0..6_u16 {
        emulated.set_motion(Motion { position_rad: 0.4 * f64::from(cycle), velocity_rad_s: 0.5, torque_nm: -0.25 });
        let mut poll_frames: Vec<Frame> = listeners.poll_frame().into_iter().collect();
        poll_frames.extend(listeners.needs_sync().then(canopen::encode_sync));
        if let Family::TMotor { motor, .. } = config.family {
            // In the real setup another master commands the motor; here the test does.
            poll_frames
                .push(Frame::classic(Id::standard(motor.into()).expect("below 2048"), &[0; 8]).expect("eight bytes"));
        }
        let mut answers: Vec<Frame> =
            poll_frames.iter().flat_map(|frame| emulated.take(frame).expect("a frame of the driver")).collect();
        answers.extend(
            emulated.report(Stamp(0) + Duration::from_millis(20) * u32::from(cycle)).expect("the motion is in range"),
        );
        expected_readings.extend(answers.iter().filter_map(|frame| listeners.read(frame)));
        sent_frames.extend(poll_frames);
        sent_frames.extend(answers);
    }
    (sent_frames, expected_readings)
}

/// The frames with which the driver makes a motor report.
pub(super) fn set_up(config: &MotorConfig) -> Vec<Frame> {
    match config.family {
        Family::Damiao { motor, .. } => {
            let read = |register| damiao::RegisterMessage { motor, access: damiao::Access::Read(register) };
            let messages = [damiao::Register::PositionLimit, damiao::Register::Timeout].map(read);
            messages.iter().map(|message| damiao::encode_register(message, None).expect("values in range")).collect()
        }
        Family::Robstride { motor, .. } => {
            let report = robstride::Request::ReportActively(true);
            vec![robstride::encode_request(ROBSTRIDE_HOST, motor, &report, &LIMITS).expect("values in range")]
        }
        Family::Cia402 { node, .. } => {
            let (pdo, direction) = (canopen::Pdo::First, canopen::Direction::Transmit);
            let objects = [
                (pdo.mapping(direction, 1), cia402::POSITION.mapped().into()),
                (pdo.mapping(direction, 2), cia402::VELOCITY.mapped().into()),
                (pdo.mapping(direction, 0), 2),
                (pdo.communication(direction, 2), 1),
                (pdo.communication(direction, 1), i64::from(pdo.id(direction, node).value())),
            ];
            let objects =
                objects.map(|(object, value)| canopen::encode_write(node, object, value).expect("values in range"));
            objects.into_iter().chain([canopen::encode_nmt(canopen::Nmt::Start, Some(node))]).collect()
        }
        Family::TMotor { .. } | Family::Odrive { .. } => Vec::new(),
    }
}
