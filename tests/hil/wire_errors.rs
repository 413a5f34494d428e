//! Inside the virtual kernel: error frames as controllers send them whose drivers tell more than that of the cards in `kvaser.rs`.
//! The kernel hands on what is written to a virtual bus, error frames, too.

use super::can::{Wire, damiao};
use drivers::can::{ArmConfig, Bus, BusEvent, CanArm, WireErrors};
use socketcan::errors::{CAN_ERR_ACK, CAN_ERR_BUSERROR, CAN_ERR_CRTL};
use socketcan::{CanErrorFrame, CanSocket, Socket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Byte 1 of an error frame about the controller: both counters passed the mark of 128 errors (`linux/can/error.h`).
const BOTH_PASSIVE: u8 = 0x10 | 0x20;

#[test]
#[ignore = "needs the virtual kernel"]
fn error_frames_are_counted() {
    let wire = Wire::new("vcan6", false);
    let bus = Bus::open(&wire.config(false)).expect("it is up");
    let controller = CanSocket::open("vcan6").expect("it is up");
    let ack_and_passive = CanErrorFrame::new_error(CAN_ERR_ACK | CAN_ERR_CRTL, &[0, BOTH_PASSIVE]).expect("two bytes");
    controller.write_frame(&ack_and_passive).expect("it is up");
    controller.write_frame(&CanErrorFrame::new_error(CAN_ERR_BUSERROR, &[]).expect("no bytes")).expect("it is up");
    let mut errors = WireErrors::default();
    while let Some((_, arrived)) = bus.receive(Duration::from_millis(200)).expect("it is up") {
        let BusEvent::Errors(new_errors) = arrived else { panic!("{arrived:?} is no error") };
        errors.add(&new_errors);
    }
    assert_eq!(errors, WireErrors { n_frames: 2, n_passive: 1, n_unacknowledged: 1, ..WireErrors::default() });
}

#[test]
#[ignore = "needs the virtual kernel"]
fn unacknowledged_motor_is_not_reported_silent() {
    let wire = Wire::new("vcan7", false);
    let stop = Arc::new(AtomicBool::new(false));
    let stopping = Arc::clone(&stop);
    let controller = std::thread::spawn(move || {
        let socket = CanSocket::open("vcan7").expect("it is up");
        let frame = CanErrorFrame::new_error(CAN_ERR_ACK, &[]).expect("no bytes");
        while !stopping.load(Ordering::Relaxed) {
            socket.write_frame(&frame).expect("it is up");
            std::thread::sleep(Duration::from_millis(5));
        }
    });
    let config = ArmConfig { buses: vec![wire.config(false)], motors: vec![damiao(1)], rate_hz: 100.0 };
    let error = CanArm::open(&config).expect_err("nobody is there").to_string();
    stop.store(true, Ordering::Relaxed);
    controller.join().expect("it only writes");
    assert!(error.contains("nobody acknowledges frames"), "{error}");
}
