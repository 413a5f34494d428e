//! The arm keeps its distance from what is near, old or unknown.

use super::{ANA, Sim, ageless, hand, is_braking, new_steering, pose_intent, words};
use crate::{
    AnalyticScene, Capsule, Clearance, ClearanceConfig, Effect, Link, Reason, Seen, Solid,
    SteeringConfig, Verdict,
};
use kinematics::{Stamp, Transform};
use nalgebra::Vector3;
use std::time::Duration;

const STOP_M: f64 = 0.02;

const BALL_M: f64 = 0.1;

/// A ball below the tip, and its center.
fn ball_below(sim: &Sim, gap_m: f64) -> (Solid, Vector3<f64>) {
    let center = sim.tip().translation.vector - Vector3::z() * (gap_m + BALL_M);
    let ball = Solid::Sphere {
        center: center.into(),
        radius_m: BALL_M,
    };
    (ball, center)
}

fn scene(solids: Vec<Solid>) -> AnalyticScene {
    AnalyticScene {
        solids,
        seen_at: Stamp(1_000_000_000),
        seen_radius_m: 10.0,
    }
}

fn has(verdict: &Verdict, is_expected: impl Fn(Effect, &Reason) -> bool) -> bool {
    let limits = verdict.limits.iter();
    limits
        .filter(|limit| limit.link == Link::Clearance)
        .any(|limit| is_expected(limit.effect, &limit.reason))
}

/// Invariant: no target is closer to a surface than the stop distance.
#[test]
fn arm_slows_before_a_surface_and_is_refused_at_it_with_the_place() {
    let mut sim = Sim::ready(ageless());
    let below = Transform::translation(0.0, 0.0, -0.4) * sim.tip();
    let (ball, center) = ball_below(&sim, 0.25);
    sim.scene = Box::new(scene(vec![ball]));
    let (mut was_slowed, mut last) = (false, None);
    for _ in 0..2000 {
        let verdict = sim.drive(Some(1), pose_intent(&below));
        was_slowed |= has(&verdict, |effect, reason| {
            matches!((effect, reason), (Effect::Slowed(_), Reason::Near { .. }))
        });
        last = Some(verdict);
    }
    let last = last.unwrap();
    assert!(was_slowed);
    let place = last
        .limits
        .iter()
        .find(|limit| limit.link == Link::Clearance && limit.effect == Effect::Refused)
        .and_then(|limit| limit.reason.place())
        .unwrap_or_else(|| panic!("{}", words(&last)));
    let from_center_m = (Vector3::from(place) - center).norm();
    assert!(
        from_center_m > BALL_M && from_center_m < BALL_M + 0.2,
        "{place:?}"
    );
    let body = crate::Body::new(&super::panda().0, &sim.chain, &|_| None).unwrap();
    let capsules = body.capsules(&last.target().unwrap().position);
    let ball = Capsule {
        ends: [center, center],
        radius_m: BALL_M,
    };
    let nearest_m = (0..body.n_parts())
        .filter(|ix| body.part(*ix).frame_ix > 0)
        .map(|ix| capsules[ix].gap(&ball).distance_m)
        .fold(f64::INFINITY, f64::min);
    assert!(nearest_m >= STOP_M, "{nearest_m}");
    // The arm has come close: the spheres of the samples are up to 12 % larger than the parts.
    assert!(nearest_m < STOP_M + 0.02, "{nearest_m}");
    // The way back is free.
    let above = Transform::translation(0.0, 0.0, 0.1) * sim.tip();
    for _ in 0..300 {
        sim.drive(Some(1), pose_intent(&above));
    }
    assert!((sim.tip().translation.z - above.translation.z).abs() < 1e-3);
}

#[test]
fn what_was_never_seen_is_occupied() {
    let mut sim = Sim::ready(ageless());
    let radius_m = sim.tip().translation.vector.norm() + 0.3;
    sim.scene = Box::new(AnalyticScene {
        seen_radius_m: radius_m,
        ..scene(Vec::new())
    });
    let outside = Transform::translation(0.6, 0.0, 0.0) * sim.tip();
    for _ in 0..600 {
        sim.drive(Some(1), pose_intent(&outside));
        assert!(sim.tip().translation.vector.norm() < radius_m);
    }
    struct Blind;
    impl Clearance for Blind {
        fn readings(&self, _: &[[f64; 3]], _: Stamp) -> Vec<Option<Seen>> {
            Vec::new()
        }
    }
    sim.drive(None, hand(0.0, 0.0, 0.0));
    sim.rest();
    sim.scene = Box::new(Blind);
    let start = sim.arm().position;
    let back = Transform::translation(-0.1, 0.0, 0.0) * sim.tip();
    for _ in 0..20 {
        let verdict = sim.drive(Some(2), pose_intent(&back));
        assert_eq!(verdict.target().unwrap().position, start);
    }
    let verdict = sim.drive(Some(2), pose_intent(&back));
    assert!(
        has(&verdict, |effect, reason| effect == Effect::Refused
            && matches!(reason, Reason::NeverSeen { .. })),
        "{}",
        words(&verdict)
    );
}

#[test]
fn a_scene_that_is_not_observed_any_more_stops_the_arm_and_no_permission_helps() {
    /// The newest readings remain, but there are no new ones.
    struct Lost(AnalyticScene);
    impl Clearance for Lost {
        fn readings(&self, points: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
            self.0.readings(points, now)
        }
        fn failure(&self) -> Option<String> {
            Some("the map has ended".to_owned())
        }
    }
    let mut sim = Sim::ready(ageless());
    for step in 0..30_u32 {
        let verdict = sim.drive(Some(1), hand(0.002 * f64::from(step), 0.0, 0.0));
        assert!(!is_braking(&verdict));
    }
    sim.scene = Box::new(Lost(scene(Vec::new())));
    let verdict = sim.drive(Some(1), hand(0.06, 0.0, 0.0));
    assert!(is_braking(&verdict));
    assert!(
        words(&verdict).contains("scene any more: the map has ended"),
        "{}",
        words(&verdict)
    );
    assert!(
        verdict
            .limits
            .iter()
            .all(|limit| limit.link == Link::Clearance)
    );
    sim.rest();
    sim.rearm(ANA).unwrap();
    sim.cycle();
    assert!(matches!(
        sim.steering.stop(),
        Some(Reason::SceneLost { .. })
    ));
    sim.send(Some(2), hand(0.0, 0.0, 0.0)).unwrap_err();
    // The record repeats the stop without the scene.
    let (entries, _) = sim.steering.take_record();
    let mut replayed = new_steering(ageless());
    for entry in &entries {
        replayed.replay(entry).unwrap();
    }
    assert_eq!(replayed.stop(), sim.steering.stop());
}

#[test]
fn an_arm_that_reports_a_stop_and_then_nothing_is_stopped() {
    let mut sim = Sim::ready(ageless());
    sim.drive(Some(1), hand(0.0, 0.0, 0.0));
    let mut arm = sim.arm();
    arm.stopped = Some("its thread panicked".to_owned());
    // The chain was held up, so that the last report is old already.
    sim.now += Duration::from_millis(500);
    let verdict = sim.steering.cycle(sim.now, &arm, sim.scene.as_ref());
    assert!(
        words(&verdict).contains("its thread panicked"),
        "{verdict:?}"
    );
    assert!(matches!(
        sim.steering.stop(),
        Some(Reason::ArmStopped { .. })
    ));
}

#[test]
fn arm_is_slower_where_nobody_looked_for_long() {
    let moved_in = |age: Duration| {
        let mut sim = Sim::ready(SteeringConfig::default());
        sim.scene = Box::new(AnalyticScene {
            seen_at: sim.now - age,
            ..scene(Vec::new())
        });
        let to = Transform::translation(0.0, 0.2, 0.0) * sim.tip();
        let start = sim.tip();
        let mut last = None;
        for _ in 0..50 {
            last = Some(sim.drive(Some(1), pose_intent(&to)));
        }
        let moved_m = (sim.tip().translation.vector - start.translation.vector).norm();
        (moved_m, last.unwrap())
    };
    let (fresh_m, _) = moved_in(Duration::ZERO);
    let (stale_m, verdict) = moved_in(Duration::from_secs(60));
    assert!(
        stale_m < 0.5 * fresh_m && stale_m > 0.0,
        "{stale_m} {fresh_m}"
    );
    assert!(
        has(&verdict, |_, reason| matches!(
            reason,
            Reason::LongUnseen { .. }
        )),
        "{}",
        words(&verdict)
    );
}

#[test]
fn surface_that_appears_at_the_target_brakes_the_arm() {
    let mut sim = Sim::ready(ageless());
    let to = Transform::translation(0.0, 0.3, 0.0) * sim.tip();
    for _ in 0..50 {
        sim.drive(Some(1), pose_intent(&to));
    }
    let center = sim.tip().translation.vector;
    sim.scene = Box::new(scene(vec![Solid::Sphere {
        center: center.into(),
        radius_m: 0.05,
    }]));
    let verdict = sim.drive(Some(1), pose_intent(&to));
    assert!(is_braking(&verdict), "{}", words(&verdict));
    assert!(
        words(&verdict).contains("from a surface"),
        "{}",
        words(&verdict)
    );
    // It stays at rest with this grip, also when the surface is gone.
    sim.scene = Box::new(scene(Vec::new()));
    sim.send(Some(1), pose_intent(&to)).unwrap_err();
    sim.rest();
    // A new grip may leave the surface, but not approach it.
    // The ball reaches 3 cm into the tool.
    let (ball, _) = ball_below(&sim, -0.03);
    sim.scene = Box::new(scene(vec![ball]));
    let down = Transform::translation(0.0, 0.0, -0.1) * sim.tip();
    let start = sim.arm().position;
    for _ in 0..30 {
        let verdict = sim.drive(Some(2), pose_intent(&down));
        assert_eq!(
            verdict.target().unwrap().position,
            start,
            "{}",
            words(&verdict)
        );
    }
    let up = Transform::translation(0.0, 0.0, 0.15) * sim.tip();
    for _ in 0..1500 {
        sim.drive(Some(2), pose_intent(&up));
    }
    assert!((sim.tip().translation.z - up.translation.z).abs() < 1e-3);
}

#[test]
fn readings_that_are_no_numbers_are_no_knowledge() {
    struct Broken(f64, f64);
    impl Clearance for Broken {
        fn readings(&self, points: &[[f64; 3]], _: Stamp) -> Vec<Option<Seen>> {
            let seen = Seen {
                distance_m: self.0,
                age_secs: self.1,
            };
            points.iter().map(|_| Some(seen)).collect()
        }
    }
    for (distance_m, age_secs) in [(f64::NAN, 0.0), (1.0, f64::NAN), (1.0, -1.0)] {
        let mut sim = Sim::ready(ageless());
        sim.scene = Box::new(Broken(distance_m, age_secs));
        let to = Transform::translation(0.0, 0.2, 0.0) * sim.tip();
        sim.drive(Some(1), pose_intent(&to));
        let verdict = sim.drive(Some(1), pose_intent(&to));
        assert!(
            words(&verdict).contains("never been seen"),
            "{}",
            words(&verdict)
        );
    }
}

#[test]
fn invalid_configurations_are_refused_by_name() {
    type Change = fn(&mut ClearanceConfig);
    let spoiled: [(&str, Change); 4] = [
        ("clearance.stop_m", |config| config.stop_m = f64::NAN),
        ("clearance.slow_m", |config| config.slow_m = 0.01),
        ("clearance.stale_frac", |config| config.stale_frac = 0.0),
        ("clearance.growth_m_s", |config| config.growth_m_s = -1.0),
    ];
    let (urdf, chain) = super::panda();
    let body = crate::Body::new(&urdf, &chain, &|_| None).unwrap();
    for (name, spoil) in spoiled {
        let mut config = ClearanceConfig::default();
        spoil(&mut config);
        let error = crate::ClearancePoints::new(config, &body, &super::START).unwrap_err();
        assert!(error.to_string().contains(name), "{error}");
    }
}
