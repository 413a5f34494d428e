//! One operator at a time: nobody else moves the arm.

use super::{ANA, BEN, PAD, Sim, ageless, hand, is_braking, words};
use crate::{Device, Operator, Output, Reason, Request};
use std::time::Duration;

#[test]
fn commands_without_control_are_refused_and_nothing_moves() {
    let mut sim = Sim::new(ageless());
    let refusal = sim.send(Some(1), hand(0.0, 0.0, 0.0)).unwrap_err();
    assert_eq!(refusal, Reason::NoLease);
    assert_eq!(
        words(&sim.cycle()),
        "braking: nobody has control: take control first"
    );
}

#[test]
fn control_cannot_be_stolen() {
    let mut sim = Sim::ready(ageless());
    sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    for request in [
        Request::TakeLease(BEN),
        Request::RenewLease(BEN),
        Request::ReleaseLease(BEN),
        Request::Rearm {
            operator: BEN,
            stop: 0,
        },
        Request::OfferLease { from: BEN, to: BEN },
    ] {
        let refusal = sim.request(request).unwrap_err();
        assert!(
            matches!(refusal, Reason::LeaseHeld { holder: ANA, .. }),
            "{refusal}"
        );
    }
    // Ben sends commands in the name of his own connection, with Ana's device and grip.
    for grip in [None, Some(1), Some(2)] {
        let mut command = sim.command(grip, hand(1.0, 0.0, 0.0));
        command.operator = BEN;
        sim.request(Request::Command(command)).unwrap_err();
    }
    let verdict = sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    let start = sim.arm().position;
    assert_eq!(
        verdict.target().unwrap().position,
        start,
        "Ben's hand moved nothing"
    );
}

#[test]
fn control_is_handed_over_only_after_an_offer_and_the_arm_brakes() {
    let mut sim = Sim::ready(ageless());
    sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    sim.request(Request::OfferLease { from: ANA, to: BEN })
        .unwrap();
    sim.request(Request::TakeLease(Operator(3))).unwrap_err();
    let verdict = sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    assert!(!is_braking(&verdict), "an offer alone changes nothing");
    sim.request(Request::TakeLease(BEN)).unwrap();
    let verdict = sim.cycle();
    assert_eq!(words(&verdict), "braking: operator 1 gave up control");
    assert!(sim.send(Some(1), hand(0.0, 0.0, 0.0)).is_err());
    // Ben's own device was never seen open, so its grip moves nothing.
    let mut command = sim.command(Some(5), hand(0.0, 0.0, 0.0));
    (command.operator, command.device) = (BEN, Device(11));
    let refusal = sim.request(Request::Command(command)).unwrap_err();
    assert!(
        matches!(refusal, Reason::GripUsedUp { grip: 5, .. }),
        "{refusal}"
    );
}

#[test]
fn offers_expire() {
    let mut sim = Sim::ready(ageless());
    sim.request(Request::OfferLease { from: ANA, to: BEN })
        .unwrap();
    for _ in 0..21 {
        sim.now += Duration::from_secs(1);
        sim.request(Request::RenewLease(ANA)).unwrap();
    }
    sim.request(Request::TakeLease(BEN)).unwrap_err();
}

#[test]
fn control_expires_with_silence_and_old_grips_do_not_return() {
    let mut sim = Sim::ready(ageless());
    sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    sim.now += Duration::from_secs(6);
    let verdict = sim.cycle();
    assert!(
        words(&verdict).contains("control of operator 1 expired after 6.0"),
        "{verdict:?}"
    );
    assert_eq!(sim.steering.holder(), None);
    sim.request(Request::TakeLease(ANA)).unwrap();
    // The pad was forgotten, so a switch that is still closed must be opened first.
    sim.send(Some(1), hand(0.0, 0.0, 0.0)).unwrap_err();
    assert!(is_braking(&sim.cycle()));
    sim.send(None, hand(0.0, 0.0, 0.0)).unwrap();
    let verdict = sim.drive(Some(2), hand(0.0, 0.0, 0.0));
    assert!(matches!(verdict.output, Output::Follow(_)));
}

#[test]
fn a_command_renews_control_from_its_receipt() {
    let mut sim = Sim::ready(ageless());
    sim.now += Duration::from_secs(1);
    let waiting = sim.command(None, hand(0.0, 0.0, 0.0));
    sim.now += Duration::from_secs(2);
    sim.request(Request::Command(waiting)).unwrap();
    let left_secs = sim.steering.lease_left_secs(sim.now);
    assert!(
        left_secs.is_some_and(|left_secs| (left_secs - 3.0).abs() < 1e-9),
        "{left_secs:?}"
    );
}

#[test]
fn clock_that_goes_back_ends_control() {
    let mut sim = Sim::ready(ageless());
    sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    sim.now = sim.now - Duration::from_secs(3600);
    let verdict = sim.cycle();
    assert!(
        words(&verdict).contains("the clock went back by 3599"),
        "{}",
        words(&verdict)
    );
    assert!(sim.send(Some(1), hand(0.0, 0.0, 0.0)).is_err());
}

#[test]
fn second_device_does_not_take_over() {
    let mut sim = Sim::ready(ageless());
    let other = |sim: &mut Sim, grip| {
        let mut command = sim.command(grip, hand(0.0, 0.0, 0.0));
        command.device = Device(11);
        sim.request(Request::Command(command))
    };
    other(&mut sim, None).unwrap();
    sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    let refusal = other(&mut sim, Some(1)).unwrap_err();
    let expected = Reason::AnotherDevice {
        device: Device(11),
        active: PAD,
    };
    assert_eq!(refusal, expected);
    assert!(!is_braking(&sim.drive(Some(1), hand(0.0, 0.0, 0.0))));
}
