//! Fuzz target: passes arbitrary frames to every codec and to an emulated motor of each family.

pub(crate) mod seeds;

use super::FAMILIES;
use super::config::{FollowingLimits, MotorConfig};
use super::emulated::EmulatedMotor;
use super::family::{LIMITS, MotorFamily};
use super::motor::{MAX_RAD, Motor};
use crate::fuzz::input::take;
use crate::wire::can::mit::Motion;
use crate::wire::can::{Frame, Id, canopen};
use kinematics::Stamp;
use std::time::Duration;

/// Payload lengths of FD frames with a DLC (data length code) above 8.
const FD_LENGTHS: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];

/// One motor of each family, each on its own bus.
pub(crate) fn motors() -> Vec<MotorConfig> {
    FAMILIES
        .iter()
        .enumerate()
        .map(|(ix, family)| example_motor(ix, *family))
        .collect()
}

/// The motor of a family. Its ratio, direction and offset are not neutral, so that the conversion
/// to the joint is exercised, too.
fn example_motor(ix: usize, family: &dyn MotorFamily) -> MotorConfig {
    MotorConfig {
        joint: format!("joint{ix}"),
        bus_ix: ix,
        protocol: family.fuzzing().motor,
        gear_ratio: 2.0,
        is_reversed: ix % 2 == 1,
        offset_rad: 0.25,
        gains: None,
        following: FollowingLimits::default(),
    }
}

/// Decodes concatenated frames. Each starts with one byte that contains the DLC (data length code)
/// and flags, followed by four bytes of ID (little-endian) and the payload.
pub(crate) fn decode_frames(mut bytes: &[u8]) -> Vec<Frame> {
    let mut frames = Vec::new();
    while !bytes.is_empty() {
        let [head] = take(&mut bytes);
        let number = u32::from_le_bytes(take(&mut bytes));
        let code = usize::from(head & 0xF);
        let is_fd = head & 0x40 != 0;
        let n_bytes = if is_fd && code > 8 {
            FD_LENGTHS[code - 9]
        } else {
            code.min(8)
        };
        let id = if head & 0x10 != 0 {
            Id::extended(number & 0x1FFF_FFFF)
        } else {
            Id::standard(number & 0x7FF)
        };
        let id = id.expect("the identifier is masked to 11 or 29 bits");
        // CAN FD has no remote frames.
        let is_remote = head & 0x20 != 0 && !is_fd;
        // Input that ends too early is padded with zeros, so that every input is a sequence of
        // valid frames.
        let payload = &take::<64>(&mut &bytes[..bytes.len().min(n_bytes)])[..n_bytes];
        let frame = if is_remote {
            Frame::remote(id, n_bytes)
        } else if is_fd {
            Frame::fd(id, payload, head & 0x80 != 0)
        } else {
            Frame::classic(id, payload)
        };
        bytes = if is_remote {
            bytes
        } else {
            &bytes[bytes.len().min(n_bytes)..]
        };
        frames.push(frame.expect("the length is valid for the format"));
    }
    frames
}

/// Feeds frames in the format of [`decode_frames`] to the codecs and motors, one per millisecond.
/// Checks that no codec panics, that every reading decoded from them or from the replies of the
/// emulated motors is plausible, and that the motion of the emulated motors stays finite.
pub fn frames(bytes: &[u8]) {
    let configs = motors();
    let listeners: Vec<_> = configs
        .iter()
        .map(|config| Motor::with_limits(config.clone(), LIMITS))
        .collect();
    let mut emulated: Vec<_> = configs
        .iter()
        .map(|config| EmulatedMotor::new(&*config.protocol, LIMITS))
        .collect();
    let mut now = Stamp(0);
    for frame in decode_frames(bytes) {
        codecs(&frame);
        now += Duration::from_millis(1);
        for (ix, emulated) in emulated.iter_mut().enumerate() {
            // Every motor gets every frame, because on a real bus, any node may send any
            // identifier.
            check(&listeners[ix], &frame);
            // As on a real motor, a command out of range gets no answer.
            let answers = emulated.take(&frame).unwrap_or_default();
            for sent in answers
                .into_iter()
                .chain(emulated.report(now).unwrap_or_default())
            {
                check(&listeners[ix], &sent);
            }
            let Motion {
                position_rad,
                velocity_rad_s,
                torque_nm,
            } = emulated.motion();
            assert!(
                [position_rad, velocity_rad_s, torque_nm]
                    .iter()
                    .all(|number| number.is_finite()),
                "{emulated:?}"
            );
        }
    }
}

/// Checks the reading of a frame, if it has one: it must lie in the range that the protocol can
/// encode and be plausible for a joint.
fn check(motor: &Motor, frame: &Frame) {
    let Some(reading) = motor.read(frame) else {
        return;
    };
    let config = motor.config();
    let limits = config.protocol.ranges().unwrap_or(LIMITS);
    // Ranges may be infinite. Then only the plausibility check of `Motor::read` applies.
    let max_rad = (limits.position_rad / config.gear_ratio + config.offset_rad.abs()).min(MAX_RAD);
    let max_rad_s = (limits.velocity_rad_s / config.gear_ratio).min(MAX_RAD);
    let max_nm = limits.torque_nm * config.gear_ratio;
    assert!(
        reading.position_rad.abs() <= max_rad + 1e-9,
        "{frame:?}: {reading:?}"
    );
    assert!(
        reading.velocity_rad_s.abs() <= max_rad_s + 1e-9,
        "{frame:?}: {reading:?}"
    );
    assert!(
        reading.effort_nm.is_none_or(|nm| nm.abs() <= max_nm + 1e-9),
        "{frame:?}: {reading:?}"
    );
}

/// Runs every codec on one frame. The only result checked here is the round trip of a `CANopen`
/// object mapping.
fn codecs(frame: &Frame) {
    let _ = canopen::decode_heartbeat(frame);
    if let Err(error) = canopen::decode_sdo(frame) {
        let _ = error.to_string();
    }
    let number = u32::from_le_bytes(take(&mut frame.data()));
    if let Ok(object) = canopen::Object::from_mapped(number) {
        assert_eq!(object.mapped(), number);
    }
    FAMILIES
        .iter()
        .for_each(|family| (family.fuzzing().run_codecs)(frame));
}

#[cfg(test)]
mod tests {
    use super::seeds::{encode_frames, example_traffic, fuzzing, record_traffic};
    use super::*;
    use crate::can::damiao::codec as dm;
    use crate::can::emulated::State;
    use crate::can::family::FamilyFuzzing;
    use crate::can::motor::Reading;
    use crate::can::odrive::{self, Odrive};
    use numbers::random::Random;
    use std::sync::Arc;

    #[test]
    fn corrupted_frames_give_no_false_reading() {
        let mut random = Random::new(1);
        for (config, (sent_frames, expected_readings)) in motors().into_iter().zip(record_traffic())
        {
            let motor = Motor::with_limits(config, LIMITS);
            assert!(expected_readings.len() >= 5, "{motor:?} reports");
            let read = |frames: &[Frame]| {
                let readings: Vec<Reading> = frames
                    .iter()
                    .filter_map(|frame| motor.read(frame))
                    .collect();
                assert!(
                    readings
                        .iter()
                        .all(|reading| expected_readings.contains(reading)),
                    "{motor:?}: {readings:?}"
                );
                readings.len()
            };
            let doubled: Vec<Frame> = sent_frames.iter().flat_map(|frame| [*frame; 2]).collect();
            assert_eq!(
                (read(&sent_frames), read(&doubled)),
                (expected_readings.len(), 2 * expected_readings.len())
            );
            for _ in 0..20 {
                let mut shuffled = sent_frames.clone();
                random.shuffle(&mut shuffled);
                assert_eq!(read(&shuffled), expected_readings.len());
            }
            for frame in &sent_frames {
                let bytes = [frame.data(), frame.data()].concat();
                let cut = (0..frame.data().len())
                    .map(|n| Frame::classic(frame.id(), &bytes[..n]).unwrap());
                read(&cut.collect::<Vec<_>>());
                if bytes.len() == 16 {
                    assert_eq!(
                        read(&[Frame::fd(frame.id(), &bytes, true).unwrap()]),
                        0,
                        "two messages in one frame are not a reading"
                    );
                }
            }
        }
    }

    /// Sends frames to an emulated motor at position 0, one per millisecond, and waits another 0.1
    /// s. Returns its position and state.
    fn shaft_after(config: &MotorConfig, frames: &[Frame]) -> (f64, State) {
        let mut emulated = EmulatedMotor::new(&*config.protocol, LIMITS);
        for millis in 0..100 + frames.len() {
            let now = Stamp(0) + Duration::from_millis(millis as u64);
            emulated.report(now).unwrap();
            if let Some(frame) = frames.get(millis) {
                // Frames that the motor cannot read have no effect.
                let _ = emulated.take(frame);
            }
        }
        (emulated.motion().position_rad, emulated.state())
    }

    #[test]
    fn disabled_motor_never_moves() {
        let mut random = Random::new(6);
        for config in motors() {
            let FamilyFuzzing {
                set_up: mut frames,
                command,
                ..
            } = fuzzing(&config);
            frames.extend([command; 20]);
            for _ in 0..20 {
                let mut corrupted = frames.clone();
                random.shuffle(&mut corrupted);
                for frame in corrupted
                    .iter_mut()
                    .filter(|frame| !frame.is_fd() && frame.data().len() > 1)
                    .step_by(3)
                {
                    *frame = Frame::classic(frame.id(), &frame.data()[..frame.data().len() - 1])
                        .unwrap();
                }
                assert_eq!(
                    shaft_after(&config, &frames),
                    (0.0, State::Free),
                    "{config:?}"
                );
                assert_eq!(
                    shaft_after(&config, &corrupted),
                    (0.0, State::Free),
                    "{config:?}"
                );
            }
        }
        let damiao = &motors()[0];
        let mit_mode = dm::Access::Write(dm::Register::ControlMode, dm::Value::Integer(1));
        let mit_mode = dm::RegisterMessage {
            motor: 1,
            access: mit_mode,
        };
        let on = [
            dm::encode_register(&mit_mode, None).unwrap(),
            dm::encode_state_command(1, dm::StateCommand::Enable).unwrap(),
            fuzzing(damiao).command,
        ];
        let (position_rad, state) = shaft_after(damiao, &on);
        assert!(
            position_rad > 0.1 && state == State::Enabled,
            "an enabled motor moves: {position_rad} rad, {state:?}"
        );
    }

    #[test]
    fn implausible_motion_is_not_a_reading() {
        let node = odrive::Node::new(4).unwrap();
        let config = MotorConfig {
            protocol: Arc::new(Odrive {
                node,
                endpoints: None,
            }),
            ..motors().remove(3)
        };
        let motor = Motor::with_limits(config, LIMITS);
        let read = |position_rad, velocity_rad_s| {
            let motion = odrive::codec::Answer::Motion {
                position_rad,
                velocity_rad_s,
            };
            motor.read(&odrive::codec::encode_answer(node, &motion).unwrap())
        };
        assert!(read(3.0, 1.0).is_some());
        assert_eq!(read(1e30, 1.0), None);
        assert_eq!(read(3.0, -1e30), None);
    }

    #[test]
    fn frames_round_trip_through_bytes() {
        let sent_frames = example_traffic();
        assert_eq!(decode_frames(&encode_frames(&sent_frames)), sent_frames);
        let id = Id::extended(0x1234).unwrap();
        let others = [
            Frame::remote(id, 5).unwrap(),
            Frame::fd(id, &[7; 48], true).unwrap(),
            Frame::fd(id, &[], false).unwrap(),
        ];
        assert_eq!(decode_frames(&encode_frames(&others)), others);
    }
}
