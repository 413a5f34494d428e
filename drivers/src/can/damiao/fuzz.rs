//! An example motor for fuzzing, and the codec's functions on arbitrary frames.

use super::{Damiao, codec};
use crate::can::family::{FamilyFuzzing, LIMITS};
use crate::fuzz::input::take;
use crate::wire::can::Frame;
use crate::wire::can::mit::Command;
use std::sync::Arc;

const MOTOR: Damiao = Damiao {
    motor: 1,
    feedback: 0x11,
};

pub(super) fn fuzzing() -> FamilyFuzzing {
    FamilyFuzzing {
        motor: Arc::new(MOTOR),
        run_codecs,
        set_up: [codec::Register::PositionLimit, codec::Register::Timeout]
            .map(|register| codec::RegisterMessage {
                motor: MOTOR.motor,
                access: codec::Access::Read(register),
            })
            .iter()
            .map(|message| {
                codec::encode_register(message, None).expect("the example can be encoded")
            })
            .collect(),
        command: codec::encode_command(MOTOR.motor, &crate::can::family::STIFF_COMMAND, &LIMITS)
            .expect("the example can be encoded"),
        transcript: include_str!("transcript.txt"),
        other_master: None,
    }
}

fn run_codecs(frame: &Frame) {
    let _ = codec::decode_register(frame);
    let _ = codec::decode_feedback(frame, &LIMITS);
    let mut data = frame.data();
    let _: [u8; 4] = take(&mut data);
    let reals: [f32; 5] = std::array::from_fn(|_| f32::from_le_bytes(take(&mut data)));
    let _ = codec::limits_from_registers(reals[0], reals[1], reals[2]);
    let [
        position_rad,
        velocity_rad_s,
        kp_nm_rad,
        kd_nm_s_rad,
        torque_nm,
    ] = reals.map(f64::from);
    let command = Command {
        position_rad,
        velocity_rad_s,
        kp_nm_rad,
        kd_nm_s_rad,
        torque_nm,
    };
    if let Ok(sent) = codec::encode_command(MOTOR.motor, &command, &LIMITS) {
        assert_eq!(sent.data().len(), 8);
    }
}
