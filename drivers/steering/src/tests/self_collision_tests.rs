//! The arm does not touch itself.

use super::{START, Sim, ageless, joint_limits, panda, words};
use crate::{Body, Effect, Intent, Link, Reason, SelfCollision, SelfCollisionConfig};
use kinematics::Chain;
use kinematics::urdf::Robot as Urdf;

fn selected() -> (Body, SelfCollision) {
    let (urdf, chain) = panda();
    let body = Body::new(&urdf, &chain, &|_| None).unwrap();
    let limits = joint_limits(&chain);
    let ranges: Vec<[f64; 2]> = limits.iter().map(|joint| joint.position).collect();
    let config = SelfCollisionConfig::default();
    let selected = SelfCollision::new(config, &body, &ranges, Some(&START)).unwrap();
    (body, selected)
}

/// Invariant: no target brings two checked parts closer than the stop distance.
#[test]
fn folding_the_arm_into_its_base_is_refused_with_both_parts() {
    let mut sim = Sim::ready(ageless());
    let (body, selected) = selected();
    let folded = vec![0.0, 1.2, 0.0, -2.9, 0.0, 1.0, 0.8];
    let mut refusal = None;
    for _ in 0..1500 {
        let intent = Intent::Joints {
            position: folded.clone(),
        };
        let verdict = sim.drive(Some(1), intent);
        let target = &verdict.target().unwrap().position;
        for pair in selected.close_pairs(&body.capsules(target)) {
            let (scale, reason) = selected.speed(&[pair], &body);
            let Some(Reason::SelfCollision { distance_m, .. }) = reason else {
                panic!("{reason:?}");
            };
            assert!(distance_m >= 0.01 && scale > 0.0, "{reason:?}");
        }
        let found = verdict
            .limits
            .iter()
            .find(|limit| limit.link == Link::SelfCollision && limit.effect == Effect::Refused);
        refusal = found.cloned().or(refusal);
    }
    let refusal = refusal.expect("the arm cannot fold into itself");
    assert!(refusal.reason.place().is_some());
    assert!(words(&sim.drive(Some(1), Intent::Joints { position: folded })).contains("mm apart"));
    // The way back is free.
    for _ in 0..1500 {
        sim.drive(
            Some(1),
            Intent::Joints {
                position: START.to_vec(),
            },
        );
    }
    let reached = sim.arm().position;
    let error = reached
        .iter()
        .zip(START)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max);
    assert!(error < 1e-6, "{reached:?}");
}

#[test]
fn pairs_are_selected_and_usual_postures_are_free() {
    let (body, selected) = selected();
    assert!(selected.n_pairs() > 50, "{}", selected.n_pairs());
    // Postures in which the arm is used, and its transport posture.
    for q in [
        START,
        [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785],
        [1.0, 0.3, -0.5, -1.5, 0.4, 1.9, -0.6],
    ] {
        let close = selected.close_pairs(&body.capsules(&q));
        let (_, reason) = selected.speed(&close, &body);
        if let Some(Reason::SelfCollision {
            distance_m, parts, ..
        }) = reason
        {
            assert!(distance_m > 0.01, "{parts:?} {distance_m}");
        }
    }
}

/// Two balls of 10 cm on rails along x and y. At zero, 5 mm are between their surfaces.
const CLOSE_BALLS: &str = r#"<robot name="balls">
    <link name="base"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
    <joint name="y" type="prismatic"><parent link="base"/><child link="rail"/><axis xyz="0 1 0"/>
        <limit lower="-0.5" upper="0.5" velocity="1" effort="1"/></joint>
    <link name="rail"/>
    <joint name="x" type="prismatic"><parent link="rail"/><child link="ball"/>
        <origin xyz="0.205 0 0"/><axis xyz="1 0 0"/>
        <limit lower="-0.1" upper="0.5" velocity="1" effort="1"/></joint>
    <link name="ball"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
</robot>"#;

/// Invariant: parts that are too close at the start do not come closer.
#[test]
fn parts_that_are_close_at_the_start_may_leave_but_not_approach_each_other() {
    let urdf = Urdf::parse(CLOSE_BALLS).unwrap();
    let chain = Chain::new(&urdf, "base", "ball").unwrap();
    let body = Body::new(&urdf, &chain, &|_| None).unwrap();
    let ranges = [[-0.5, 0.5], [-0.1, 0.5]];
    let config = SelfCollisionConfig::default();
    let started = SelfCollision::new(config, &body, &ranges, Some(&[0.0, 0.0])).unwrap();
    assert_eq!(started.n_pairs(), 1);
    let notes = started.notes().join("\n");
    let has_note = notes.contains("base and ball") && notes.contains("are 5 mm apart");
    assert!(has_note && started.notes().len() == 1, "{notes}");
    let refusal = |from: [f64; 2], to: [f64; 2]| {
        let [here, there] = [from, to].map(|q| started.close_pairs(&body.capsules(&q)));
        started.refusal(&here, &there, &body)
    };
    let closer = refusal([0.0, 0.0], [0.0, -0.002]);
    assert!(
        matches!(closer, Some(Reason::SelfCollision { .. })),
        "{closer:?}"
    );
    // In small steps, too.
    let mut x = 0.0;
    while refusal([0.0, x], [0.0, x - 1e-4]).is_none() {
        x -= 1e-4;
        assert!(x > -0.0015, "{x}");
    }
    assert_eq!(refusal([0.0, 0.0], [0.0, 0.01]), None, "it leaves");
    assert_eq!(refusal([0.0, 0.0], [0.0, 0.0]), None, "it rests");
    assert_eq!(refusal([0.0, 0.1], [0.0, 0.0]), None, "it returns");
    let from_afar = refusal([0.0, 0.03], [0.0, -0.01]);
    assert!(from_afar.is_some(), "closer than at the start");
    // They do not slow the arm down where it was put.
    let here = started.close_pairs(&body.capsules(&[0.0, 0.0]));
    assert_eq!(started.speed(&here, &body), (1.0, None));
}

#[test]
fn wrong_numbers_of_joints_are_refused() {
    let (body, _) = selected();
    let config = SelfCollisionConfig::default();
    let error = SelfCollision::new(config, &body, &[[0.0, 1.0]], None).unwrap_err();
    assert!(
        error.to_string().contains("has 1 joints, the arm has 7"),
        "{error}"
    );
}
