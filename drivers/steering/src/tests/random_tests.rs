//! Random events and targets: what must always hold.

use super::{ANA, BEN, CYCLE, PAD, START, Sim, ageless, hand, is_braking, pose_intent};
use crate::{Device, Intent, Operator, Reason, Request, Verdict};
use kinematics::{Stamp, Transform};
use nalgebra::Vector3;
use numbers::random::Random;
use std::time::Duration;

/// Number of random targets.
const N_TARGETS: u32 = 100_000;
/// Speed of the tip, relative to the fastest part, if the arm turns about a near axis: the tip is
/// 0.107 m in front of the last axis of the wrist, 0.05 m beyond the last part.
const MAX_TIP_EXCESS: f64 = 2.0;
/// Number of random events.
const N_EVENTS: u32 = 20_000;

fn random_pose(random: &mut Random) -> Transform {
    let mut vector = |scale: f64| {
        Vector3::new(
            random.uniform(-scale, scale),
            random.uniform(-scale, scale),
            random.uniform(-scale, scale),
        )
    };
    Transform::new(vector(1.2), vector(3.0))
}

/// A target as a broken or hostile sender may send it.
fn random_intent(random: &mut Random, tip: &Transform) -> Intent {
    match random.below(10) {
        0 => pose_intent(&random_pose(random)),
        1 => pose_intent(&(Transform::translation(1e6, -1e9, 1e300) * *tip)),
        2 => Intent::Pose {
            base_from_tip: [0.0; 7],
        },
        3 => {
            let mut position: Vec<f64> = (0..7).map(|_| random.uniform(-4.0, 4.0)).collect();
            position[random.below(7)] *= if random.below(4) == 0 { f64::NAN } else { 1.0 };
            Intent::Joints { position }
        }
        4 => Intent::JointVelocity {
            velocity: (0..7).map(|_| random.normal() * 10.0).collect(),
        },
        5 => Intent::TipVelocity {
            linear_m_s: std::array::from_fn(|_| random.normal()),
            angular_rad_s: std::array::from_fn(|_| random.normal() * 1e3),
        },
        6 => hand(random.normal() * 1e-3, f64::INFINITY, 0.0),
        7 => Intent::Joints {
            position: vec![0.0; random.below(12)],
        },
        // Near the present pose, so that motions happen.
        _ => pose_intent(&(Transform::translation(random.normal() * 0.05, 0.0, 0.0) * *tip)),
    }
}

/// Invariant: the tip's target moves at most at its maximum speed.
fn check_speed(sim: &Sim, before: Option<&Verdict>, after: &Verdict) {
    let (Some(before), Some(after)) = (before.and_then(Verdict::target), after.target()) else {
        return;
    };
    if before.motion != after.motion {
        return;
    }
    let tip = |q: &[f64]| sim.chain.forward(q).unwrap();
    let (start, end) = (tip(&before.position), tip(&after.position));
    let moved_m = (end.translation.vector - start.translation.vector).norm();
    // The tip is on no part. In motions of the joints, it may be faster than the nearest part.
    assert!(
        moved_m <= 0.25 * CYCLE.as_secs_f64() * MAX_TIP_EXCESS,
        "{moved_m}"
    );
}

/// Invariants: no limit is broken, whatever is sent; the chain never ends in a state from which it
/// cannot move.
#[test]
fn hundred_thousand_random_targets_break_no_limit_and_end_nowhere() {
    let mut sim = Sim::ready(ageless());
    let mut random = Random::new(7);
    let mut grip = 1;
    let mut before: Option<Verdict> = None;
    let (mut n_followed, mut n_refused) = (0, 0);
    for _ in 0..N_TARGETS {
        let tip = sim.tip();
        let intent = random_intent(&mut random, &tip);
        let mut command = sim.command(Some(grip), intent);
        match random.below(40) {
            0 => command.sequence -= 1,
            1 => command.sequence = 0,
            2 => command.captured_at = Stamp(i64::MIN),
            3 => command.captured_at = Stamp(i64::MAX),
            4 => command.captured_at = command.captured_at - Duration::from_millis(250),
            _ => {}
        }
        if sim.request(Request::Command(command)).is_err() {
            n_refused += 1;
        }
        // `Sim` checks velocity, acceleration, jerk and ranges of the setpoints.
        let verdict = sim.cycle();
        check_speed(&sim, before.as_ref(), &verdict);
        if is_braking(&verdict) {
            grip += 1;
        } else {
            n_followed += 1;
        }
        before = Some(verdict);
    }
    assert!(
        n_followed > N_TARGETS / 2 && n_refused > N_TARGETS / 10,
        "{n_followed} {n_refused}"
    );
    sim.drive(None, hand(0.0, 0.0, 0.0));
    sim.rest();
    assert!(
        returns(&mut sim, &mut random, grip + 1),
        "a dead end: {:?}",
        sim.arm()
    );
}

/// Whether the arm gets back to its first posture. The straight way may lead through the arm
/// itself, so an operator goes around.
fn returns(sim: &mut Sim, random: &mut Random, grip: u64) -> bool {
    const MAX_ATTEMPTS: u32 = 40;
    for _ in 0..MAX_ATTEMPTS {
        for _ in 0..1000 {
            let position = START.to_vec();
            sim.drive(Some(grip), Intent::Joints { position });
            let reached = sim.arm().position;
            if reached.iter().zip(START).all(|(a, b)| (a - b).abs() < 1e-6) {
                return true;
            }
        }
        let aside: Vec<f64> = START
            .iter()
            .map(|q| q + random.uniform(-1.0, 1.0))
            .collect();
        for _ in 0..200 {
            let position = aside.clone();
            sim.drive(Some(grip), Intent::Joints { position });
        }
    }
    false
}

/// What the events so far permit, written down independently of the chain.
#[derive(Default)]
struct Permission {
    /// The device whose grip was accepted, and when it was last heard.
    held: Option<(Device, Stamp)>,
    is_stopped: bool,
    last_motion: u64,
    was_braking: bool,
}

impl Permission {
    fn note(&mut self, now: Stamp, request: &Request, result: &Result<(), Reason>) {
        match (request, result) {
            (Request::Stop { .. }, _) => {
                self.is_stopped = true;
                self.held = None;
            }
            (Request::Rearm { .. }, Ok(())) => {
                self.is_stopped = false;
                self.held = None;
            }
            (Request::ReleaseLease(_), Ok(()))
            | (Request::Command(_), Err(Reason::HandJumped { .. })) => self.held = None,
            (Request::Command(command), Ok(())) => match command.grip {
                Some(_) => {
                    assert!(!self.is_stopped, "a grip was accepted during a stop");
                    self.held = Some((command.device, now));
                }
                None if self
                    .held
                    .is_some_and(|(device, _)| device == command.device) =>
                {
                    self.held = None;
                }
                None => {}
            },
            _ => {}
        }
    }

    fn check(&mut self, sim: &Sim, verdict: &Verdict) {
        let Some(target) = verdict.target() else {
            self.was_braking = true;
            return;
        };
        let silent_secs = self.held.map(|(_, heard_at)| sim.now.secs_since(heard_at));
        assert!(!self.is_stopped, "a stopped arm moves");
        assert!(
            sim.steering.holder().is_some(),
            "an arm moves that nobody controls"
        );
        assert!(
            silent_secs.is_some_and(|secs| secs <= 0.12 + 1e-9),
            "an arm moves without a grip: {silent_secs:?}"
        );
        let left_secs = target.expires_at.secs_since(sim.now);
        assert!((0.0..=0.1 + 1e-9).contains(&left_secs), "{left_secs}");
        if self.was_braking {
            assert!(
                target.motion > self.last_motion,
                "a motion continues after braking"
            );
        }
        self.last_motion = target.motion;
        self.was_braking = false;
    }
}

fn random_request(sim: &mut Sim, random: &mut Random, grips: &mut [u64; 3]) -> Request {
    let operator = if random.below(8) == 0 { BEN } else { ANA };
    match random.below(200) {
        0 => Request::TakeLease(BEN),
        1 => Request::TakeLease(Operator(3)),
        2 => Request::ReleaseLease(operator),
        3 => Request::OfferLease {
            from: operator,
            to: BEN,
        },
        4 => Request::Stop { by: Some(operator) },
        5..=14 => Request::Rearm {
            operator,
            stop: sim.steering.stop_number(),
        },
        15..=30 => Request::TakeLease(ANA),
        _ => {
            let ix = if random.below(10) == 0 {
                random.below(3)
            } else {
                0
            };
            let grip = match random.below(20) {
                0 => None,
                1 => {
                    grips[ix] += 1;
                    Some(grips[ix])
                }
                2 => Some(random.bits() % (grips[ix] + 1)),
                _ => Some(grips[ix]),
            };
            let step = [0.0; 3].map(|_: f64| random.normal() * 0.01);
            let mut command = sim.command(grip, hand(step[0], step[1], step[2]));
            command.operator = operator;
            command.device = [PAD, Device(11), Device(12)][ix];
            Request::Command(command)
        }
    }
}

/// Invariants: the arm moves only with a lease, with a grip that was heard within the silence
/// limit, and not during a stop; every motion after braking has a new number; targets expire.
#[test]
fn random_events_never_move_an_arm_without_permission() {
    let mut sim = Sim::ready(ageless());
    let mut random = Random::new(11);
    let mut permission = Permission::default();
    let mut grips = [0; 3];
    let mut n_followed = 0;
    let mut holder = sim.steering.holder();
    for _ in 0..N_EVENTS {
        let request = random_request(&mut sim, &mut random, &mut grips);
        let result = sim.request(request.clone());
        permission.note(sim.now, &request, &result);
        let may_change = matches!(request, Request::TakeLease(_) | Request::ReleaseLease(_));
        if !may_change {
            assert_eq!(
                sim.steering.holder(),
                holder,
                "only these requests change the holder"
            );
        } else if sim.steering.holder() != holder {
            permission.held = None;
        }
        if random.below(200) == 0 {
            sim.now += Duration::from_millis(u64::from(random.byte()) * 40);
        }
        if random.below(400) == 0 {
            sim.stopped = Some("a fault".to_owned());
            permission.note(sim.now, &Request::Stop { by: None }, &Ok(()));
        }
        let verdict = sim.cycle();
        sim.stopped = None;
        permission.check(&sim, &verdict);
        holder = sim.steering.holder();
        n_followed += u32::from(!is_braking(&verdict));
    }
    assert!(
        n_followed > N_EVENTS / 20 && n_followed < N_EVENTS,
        "{n_followed}"
    );
}

#[test]
fn fastest_joint_motion_respects_the_speed_of_every_part() {
    let mut sim = Sim::ready(ageless());
    let body = crate::Body::new(&super::panda().0, &sim.chain, &|_| None).unwrap();
    let mut before: Option<Vec<f64>> = None;
    for _ in 0..300 {
        let velocity = vec![2.0, 0.0, 1.0, 0.0, 1.0, 0.0, 9.0];
        let verdict = sim.drive(Some(1), Intent::JointVelocity { velocity });
        let target = verdict.target().unwrap().position.clone();
        if let Some(before) = before {
            let moved = body
                .capsules(&before)
                .into_iter()
                .zip(body.capsules(&target));
            for (start, end) in moved {
                for ix in 0..2 {
                    let moved_m = (end.ends[ix] - start.ends[ix]).norm();
                    assert!(moved_m <= 0.25 * 0.01 * (1.0 + 1e-6), "{moved_m}");
                }
            }
        }
        before = Some(target);
    }
    assert!(before.unwrap()[0] > START[0] + 0.3, "it moves");
}
