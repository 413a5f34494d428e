//! The arm follows only a grip that was seen to begin, and never jumps.

use super::{ANA, BEN, CYCLE, Sim, ageless, hand, is_braking, words};
use crate::{ArmState, Intent, NotFollowed, Output, Reason, Request};
use kinematics::Stamp;
use numbers::random::Random;
use std::time::Duration;

/// A hand pose anywhere.
fn anywhere(random: &mut Random) -> Intent {
    let quaternion: [f64; 4] = std::array::from_fn(|_| random.normal());
    let norm = quaternion
        .iter()
        .map(|value| value * value)
        .sum::<f64>()
        .sqrt();
    let [i, j, k, w] = quaternion.map(|value| value / norm);
    let [x, y, z] = std::array::from_fn(|_| random.uniform(-3.0, 3.0));
    Intent::Hand {
        base_from_hand: [x, y, z, i, j, k, w],
    }
}

fn moved(intent: &Intent, by: [f64; 3]) -> Intent {
    let Intent::Hand { mut base_from_hand } = intent.clone() else {
        panic!("not a hand: {intent:?}");
    };
    for (value, by) in base_from_hand.iter_mut().zip(by) {
        *value += by;
    }
    Intent::Hand { base_from_hand }
}

/// Invariant: a new grip starts at the pose of the tip, wherever the hand is, also while the arm
/// still brakes. `Sim` checks that setpoints continue within the limits of one cycle.
#[test]
fn thousand_new_grips_with_the_hand_anywhere_are_continuous() {
    let mut sim = Sim::ready(ageless());
    let mut random = Random::new(1);
    for grip in 1..=1000 {
        let start = anywhere(&mut random);
        let mut is_first = true;
        let direction: [f64; 3] = std::array::from_fn(|_| random.uniform(-1e-3, 1e-3));
        for step in 0..20_u32 {
            let by = direction.map(|side| side * f64::from(step));
            let before = sim.arm().position;
            let verdict = sim.drive(Some(grip), moved(&start, by));
            let Some(target) = verdict.target() else {
                assert!(
                    words(&verdict).contains("still braking"),
                    "{}",
                    words(&verdict)
                );
                continue;
            };
            if std::mem::take(&mut is_first) {
                // The hand stood still up to the sample with which the motion starts.
                assert_eq!(
                    target.position, before,
                    "grip {grip} starts at rest, where the arm is"
                );
            }
        }
        if grip % 2 == 0 {
            sim.drive(None, start);
        } else {
            // The message of the release is lost. The number of the next grip shows it.
            sim.cycle();
        }
    }
}

#[test]
fn tip_makes_the_motion_of_the_hand() {
    let mut sim = Sim::ready(ageless());
    let before = sim.tip();
    let half_angle = 0.05_f64;
    for step in 0..400_u32 {
        let part = f64::from(step.min(100)) / 100.0;
        let (sine, cosine) = (part * half_angle).sin_cos();
        let base_from_hand = [
            7.0 + 0.03 * part,
            -2.0,
            1.0 - 0.02 * part,
            0.0,
            0.0,
            sine,
            cosine,
        ];
        sim.drive(Some(1), Intent::Hand { base_from_hand });
    }
    let moved = sim.tip().translation.vector - before.translation.vector;
    let expected = nalgebra::Vector3::new(0.03, 0.0, -0.02);
    // Inverse kinematics stops at an error of 1e-7.
    assert!((moved - expected).norm() < 1e-5, "{moved}");
    let turned = (sim.tip().rotation * before.rotation.inverse()).scaled_axis();
    let expected = nalgebra::Vector3::z() * (2.0 * half_angle);
    assert!((turned - expected).norm() < 1e-5, "{turned}");
}

#[test]
fn released_arm_brakes_at_once_and_the_same_grip_is_used_up() {
    let mut sim = Sim::ready(ageless());
    for step in 0..50_u32 {
        sim.drive(Some(1), hand(0.002 * f64::from(step), 0.0, 0.0));
    }
    assert!(!sim.follower.is_at_rest());
    let verdict = sim.drive(None, hand(0.1, 0.0, 0.0));
    assert_eq!(words(&verdict), "braking: the dead-man switch is open");
    let refusal = sim.send(Some(1), hand(0.1, 0.0, 0.0)).unwrap_err();
    assert!(
        refusal
            .to_string()
            .contains("open and close the dead-man switch"),
        "{refusal}"
    );
    sim.rest();
    assert!(!is_braking(&sim.drive(Some(2), hand(0.1, 0.0, 0.0))));
}

#[test]
fn release_counts_even_if_the_message_is_old_repeated_or_broken() {
    for ix in 0..3 {
        let mut sim = Sim::ready(ageless());
        sim.drive(Some(1), hand(0.0, 0.0, 0.0));
        sim.drive(Some(1), hand(0.0, 0.0, 0.0));
        let mut command = sim.command(None, hand(0.0, 0.0, 0.0));
        match ix {
            0 => command.captured_at = Stamp(0),
            1 => command.sequence = 1,
            _ => command.intent = hand(f64::NAN, 0.0, 0.0),
        }
        sim.request(Request::Command(command)).unwrap();
        assert!(is_braking(&sim.cycle()), "{ix}");
    }
}

/// Invariant: silence stops, and a device that returns must grip again.
#[test]
fn silent_device_brakes_the_arm_and_must_grip_again() {
    let mut sim = Sim::ready(ageless());
    sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    let sent_at = sim.now - CYCLE;
    let mut verdict = sim.cycle();
    while !is_braking(&verdict) {
        verdict = sim.cycle();
    }
    let silence = sim.now.secs_since(sent_at);
    assert!(silence > 0.12 && silence < 0.15, "{silence}");
    assert!(
        words(&verdict).contains("device 10 was silent"),
        "{}",
        words(&verdict)
    );
    sim.send(Some(1), hand(0.0, 0.0, 0.0)).unwrap_err();
    assert!(
        is_braking(&sim.cycle()),
        "the device has returned, but its grip is old"
    );
    assert!(!is_braking(&sim.drive(Some(2), hand(0.0, 0.0, 0.0))));
}

/// Invariant: a permission undoes only stops that its operator has seen.
#[test]
fn a_permission_names_the_newest_stop() {
    let mut sim = Sim::ready(ageless());
    sim.request(Request::Stop { by: Some(BEN) }).unwrap();
    let operator = ANA;
    let stop = sim.steering.stop_number();
    sim.request(Request::Stop { by: None }).unwrap();
    let refusal = sim.request(Request::Rearm { operator, stop }).unwrap_err();
    let newest = stop + 1;
    assert_eq!(
        refusal,
        Reason::OtherStop {
            named: stop,
            newest
        }
    );
    assert!(is_braking(&sim.cycle()) && sim.steering.stop().is_some());
    // A fault that lasts counts once, and again after a permission.
    sim.stopped = Some("a motor is silent".to_owned());
    for _ in 0..3 {
        sim.cycle();
    }
    assert_eq!(sim.steering.stop_number(), newest + 1);
    sim.rearm(ANA).unwrap();
    sim.cycle();
    assert_eq!(sim.steering.stop_number(), newest + 2);
    sim.stopped = None;
    sim.rearm(ANA).unwrap();
    sim.cycle();
    assert_eq!(sim.steering.stop(), None);
}

/// Invariant: a command that waited for its decision does not look fresh.
#[test]
fn silence_counts_from_the_receipt_of_a_command_and_not_from_its_decision() {
    let mut sim = Sim::ready(ageless());
    for step in 0..20_u32 {
        sim.drive(Some(1), hand(0.002 * f64::from(step), 0.0, 0.0));
    }
    let last = sim.command(Some(1), hand(0.04, 0.0, 0.0));
    let received_at = last.received_at;
    // The device is silent from here on. Its last command waits.
    sim.now += Duration::from_millis(60);
    sim.request(Request::Command(last)).unwrap();
    let mut verdict = sim.cycle();
    let target = verdict.target().expect("the device was heard 70 ms ago");
    assert!(
        target.expires_at <= received_at.plus_secs(0.12),
        "the arm itself must notice the silence in time: {target:?}"
    );
    while !is_braking(&verdict) {
        verdict = sim.cycle();
    }
    let silence = sim.now.secs_since(received_at);
    assert!(silence > 0.12 && silence < 0.15, "{silence}");
    assert!(
        words(&verdict).contains("device 10 was silent"),
        "{}",
        words(&verdict)
    );
}

/// Invariant: a grip whose commands have waited for longer than a device may be silent moves
/// nothing.
#[test]
fn a_grip_that_waited_for_too_long_never_begins() {
    let mut sim = Sim::ready(ageless());
    let waiting = sim.command(Some(1), hand(0.0, 0.0, 0.0));
    sim.now += Duration::from_millis(200);
    sim.request(Request::Command(waiting)).unwrap();
    let verdict = sim.cycle();
    assert!(is_braking(&verdict), "{}", words(&verdict));
    sim.send(Some(1), hand(0.0, 0.0, 0.0)).unwrap_err();
}

#[test]
fn commands_that_are_not_used_do_not_count_as_signs_of_life() {
    let unusable: [fn(&mut crate::Command); 6] = [
        |command| command.sequence = 2,
        |command| command.captured_at = command.captured_at - Duration::from_secs(1),
        |command| command.captured_at += Duration::from_secs(1),
        |command| command.intent = hand(f64::NAN, 0.0, 0.0),
        |command| command.intent = hand(0.0, f64::INFINITY, 0.0),
        |command| {
            let position = vec![0.0; 6];
            command.intent = Intent::Joints { position };
        },
    ];
    for (ix, spoil) in unusable.iter().enumerate() {
        let mut sim = Sim::ready(ageless());
        sim.drive(Some(1), hand(0.0, 0.0, 0.0));
        let mut has_braked = false;
        for _ in 0..20 {
            let mut command = sim.command(Some(1), hand(0.0, 0.0, 0.0));
            spoil(&mut command);
            sim.request(Request::Command(command)).unwrap_err();
            has_braked = is_braking(&sim.cycle());
        }
        assert!(has_braked, "{ix}");
    }
}

#[test]
fn jump_of_the_hand_opens_the_clutch() {
    let mut sim = Sim::ready(ageless());
    sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    let refusal = sim.send(Some(1), hand(0.5, 0.0, 0.0)).unwrap_err();
    assert!(matches!(refusal, Reason::HandJumped { .. }), "{refusal}");
    let verdict = sim.cycle();
    assert!(
        words(&verdict).contains("the hand jumped by 0.50 m"),
        "{}",
        words(&verdict)
    );
}

/// Invariant: after a stop, nothing moves before the holder permits it and grips again.
#[test]
fn stop_of_anybody_latches() {
    for by in [Some(BEN), Some(ANA), None] {
        let mut sim = Sim::ready(ageless());
        sim.drive(Some(1), hand(0.0, 0.0, 0.0));
        sim.request(Request::Stop { by }).unwrap();
        assert!(words(&sim.cycle()).contains("braking: stopped by"));
        sim.send(None, hand(0.0, 0.0, 0.0)).unwrap();
        for grip in 2..5 {
            let refusal = sim.send(Some(grip), hand(0.0, 0.0, 0.0)).unwrap_err();
            assert!(
                refusal.to_string().contains("permit motion again"),
                "{refusal}"
            );
            assert!(is_braking(&sim.cycle()));
        }
        sim.rearm(BEN).unwrap_err();
        sim.rearm(ANA).unwrap();
        sim.send(Some(4), hand(0.0, 0.0, 0.0)).unwrap_err();
        assert!(
            is_braking(&sim.cycle()),
            "the grip was closed before motion was permitted"
        );
        assert!(!is_braking(&sim.drive(Some(5), hand(0.0, 0.0, 0.0))));
    }
}

#[test]
fn fault_of_the_arm_latches_too() {
    let mut sim = Sim::ready(ageless());
    sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    sim.stopped = Some("motor 3 is too hot".to_owned());
    assert!(words(&sim.cycle()).contains("the arm stopped: motor 3 is too hot"));
    sim.rearm(ANA).unwrap();
    assert!(
        words(&sim.cycle()).contains("too hot"),
        "the fault is still there"
    );
    sim.stopped = None;
    assert!(
        words(&sim.cycle()).contains("too hot"),
        "a person must permit motion"
    );
    sim.rearm(ANA).unwrap();
    assert!(!is_braking(&sim.drive(Some(2), hand(0.0, 0.0, 0.0))));
}

#[test]
fn arm_that_reports_nothing_usable_brakes() {
    let broken: [fn(&mut ArmState); 3] = [
        |arm| arm.reported_at = Stamp(0),
        |arm| arm.position[2] = f64::NAN,
        |arm| arm.position.truncate(3),
    ];
    for (ix, break_report) in broken.iter().enumerate() {
        let mut sim = Sim::ready(ageless());
        sim.drive(Some(1), hand(0.0, 0.0, 0.0));
        sim.send(Some(1), hand(0.0, 0.0, 0.0)).unwrap();
        let mut arm = sim.arm();
        break_report(&mut arm);
        let verdict = sim.steering.cycle(sim.now, &arm, sim.scene.as_ref());
        assert!(is_braking(&verdict), "{ix}");
    }
}

/// Invariant: the arm's thread brakes when targets expire, and does not move again with
/// the same grip.
#[test]
fn arm_brakes_without_the_chain_and_needs_a_new_grip() {
    let mut sim = Sim::ready(ageless());
    let mut last = Output::Brake;
    for step in 0..60_u32 {
        last = sim
            .drive(Some(1), hand(0.002 * f64::from(step), 0.0, 0.0))
            .output;
    }
    let Output::Follow(target) = last else {
        panic!("{last:?}");
    };
    let motion = target.motion;
    // The chain is stuck. The arm follows its last target until it expires.
    let mut n_cycles_to_brake = 0;
    while sim.follower.braked_motion() < motion {
        sim.now += CYCLE;
        sim.step_arm();
        n_cycles_to_brake += 1;
        assert!(n_cycles_to_brake < 15, "braking begins within 150 ms");
    }
    for _ in 0..100 {
        sim.now += CYCLE;
        sim.step_arm();
    }
    assert!(sim.follower.is_at_rest());
    // The chain continues where it was stuck. Its lease is still valid.
    let revived = crate::Target {
        serial: target.serial + 1,
        expires_at: sim.now + CYCLE,
        ..target.clone()
    };
    let refusal = sim
        .follower
        .obey(sim.now, &Output::Follow(revived))
        .unwrap_err();
    assert!(
        matches!(refusal, NotFollowed::MotionEnded { .. }),
        "{refusal}"
    );
    let repeated = sim
        .follower
        .obey(sim.now, &Output::Follow(target))
        .unwrap_err();
    assert!(
        matches!(repeated, NotFollowed::OutOfOrder { .. }),
        "{repeated}"
    );
    sim.cycle();
    sim.send(None, hand(0.0, 0.0, 0.0)).unwrap();
    assert!(!is_braking(&sim.drive(Some(2), hand(0.0, 0.0, 0.0))));
}

#[test]
fn braking_uses_the_brake_limits() {
    let mut sim = Sim::ready(ageless());
    let to = vec![1.5, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];
    for _ in 0..200 {
        sim.drive(
            Some(1),
            Intent::Joints {
                position: to.clone(),
            },
        );
    }
    let speed = sim.follower.setpoint().velocity[0].abs();
    assert!(speed > 0.1, "{speed}");
    sim.drive(None, hand(0.0, 0.0, 0.0));
    let mut strongest = 0.0_f64;
    while !sim.follower.is_at_rest() {
        sim.cycle();
        strongest = strongest.max(sim.follower.setpoint().acceleration[0].abs());
    }
    // Joint 1 accelerates with 2 rad/s² at most.
    let reached = speed.min(1.0);
    assert!(strongest > 2.0 || reached < 0.4, "{strongest} from {speed}");
}

#[test]
fn brake_limits_below_motion_limits_are_refused() {
    let (_, chain) = super::panda();
    let limits = super::joint_limits(&chain);
    let weak = crate::brake_limits(&limits, 0.5);
    let error = crate::Follower::new(&limits, &weak, &super::START, CYCLE).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("the acceleration of joint 1 for braking"),
        "{error}"
    );
}

/// Invariant: braking respects its limits also for a joint whose range does not contain 0. The
/// state of joint 4 is one in which the library once planned with more than twice the jerk.
#[test]
fn joint_whose_range_does_not_contain_zero_brakes_within_its_limits() {
    let (_, chain) = super::panda();
    let limits = super::joint_limits(&chain);
    let brake = crate::brake_limits(&limits, super::BRAKE_FACTOR);
    let mut sim = Sim::ready(ageless());
    let mut random = Random::new(5);
    for grip in 1..200 {
        // Back and forth, so that joint 4 is stopped in many states of motion.
        let n_cycles = 5 + random.below(30);
        let to = random.uniform(-2.6, -1.8);
        for _ in 0..n_cycles {
            let position = vec![0.0, -0.5, 0.0, to, 0.0, 1.8, 0.8];
            sim.drive(Some(grip), Intent::Joints { position });
        }
        let before = sim.follower.setpoint().clone();
        sim.drive(None, hand(0.0, 0.0, 0.0));
        let after = sim.follower.setpoint().clone();
        let jerked = (after.acceleration[3] - before.acceleration[3]).abs();
        assert!(
            jerked <= brake[3].jerk * CYCLE.as_secs_f64() * 1.0001,
            "{before:?} {after:?}"
        );
        sim.rest();
    }
}
