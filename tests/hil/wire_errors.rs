//! Tests of CAN error frames inside the virtual kernel, which forwards error frames written to a
//! virtual bus. They cover drivers that report more details than the driver of the cards in
//! `kvaser.rs`.

use super::can::{Wire, damiao};
use drivers::can::{ArmConfig, Bus, BusEvent, CanArm, WireErrors};
use socketcan::errors::{CAN_ERR_ACK, CAN_ERR_BUSERROR, CAN_ERR_CRTL};
use socketcan::{CanErrorFrame, CanSocket, Socket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Byte 1 of an error frame about the controller: both error counters exceeded 127
/// (`linux/can/error.h`).
const BOTH_PASSIVE: u8 = 0x10 | 0x20;

#[test]
#[ignore = "needs the virtual kernel"]
fn error_frames_are_counted() {
    let wire = Wire::new("vcan6", false);
    let bus = Bus::open(&wire.config(false)).expect("the bus is up");
    let controller = CanSocket::open("vcan6").expect("the bus is up");
    let ack_and_passive = CanErrorFrame::new_error(CAN_ERR_ACK | CAN_ERR_CRTL, &[0, BOTH_PASSIVE])
        .expect("two bytes");
    controller
        .write_frame(&ack_and_passive)
        .expect("the bus is up");
    controller
        .write_frame(&CanErrorFrame::new_error(CAN_ERR_BUSERROR, &[]).expect("no bytes"))
        .expect("the bus is up");
    let mut errors = WireErrors::default();
    while let Some((_, arrived)) = bus
        .receive(Duration::from_millis(200))
        .expect("the bus is up")
    {
        let BusEvent::Errors(new_errors) = arrived else {
            panic!("{arrived:?} is not an error frame")
        };
        errors.add(&new_errors);
    }
    assert_eq!(
        errors,
        WireErrors {
            n_frames: 2,
            n_passive: 1,
            n_unacknowledged: 1,
            ..WireErrors::default()
        }
    );
}

#[test]
#[ignore = "needs the virtual kernel"]
fn unacknowledged_motor_is_not_reported_silent() {
    let wire = Wire::new("vcan7", false);
    let stop = Arc::new(AtomicBool::new(false));
    let stopping = Arc::clone(&stop);
    let controller = std::thread::spawn(move || {
        let socket = CanSocket::open("vcan7").expect("the bus is up");
        let frame = CanErrorFrame::new_error(CAN_ERR_ACK, &[]).expect("no bytes");
        while !stopping.load(Ordering::Relaxed) {
            socket.write_frame(&frame).expect("the bus is up");
            std::thread::sleep(Duration::from_millis(5));
        }
    });
    let config = ArmConfig {
        buses: vec![wire.config(false)],
        motors: vec![damiao(1)],
        rate_hz: 100.0,
    };
    let error = CanArm::open(&config)
        .expect_err("no motor is connected")
        .to_string();
    stop.store(true, Ordering::Relaxed);
    controller.join().expect("the thread does not panic");
    assert!(error.contains("no node acknowledges frames"), "{error}");
}
