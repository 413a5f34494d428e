//! Arms whose controller takes a while to start a motion, and may be moved by hand until then.

use super::{CYCLE, START, Sim, ageless, hand, is_braking, words};
use crate::Verdict;

/// Speed of the hand, less than that of the tip may be.
const HAND_STEP_M: f64 = 0.002;

/// A sample and a cycle of the chain. The arm does not take the target.
fn decide_alone(sim: &mut Sim, step: u32) -> Verdict {
    let intent = hand(HAND_STEP_M * f64::from(step), 0.0, 0.0);
    sim.send(Some(1), intent).unwrap();
    sim.now += CYCLE;
    let arm = sim.arm();
    sim.steering.cycle(sim.now, &arm, sim.scene.as_ref())
}

/// Invariant: an arm that begins late need not catch up with a target that has moved on.
#[test]
fn target_stays_one_step_ahead_of_an_arm_that_has_not_begun() {
    let mut sim = Sim::ready(ageless());
    let tip_at = |sim: &Sim, q: &[f64]| sim.chain.forward(q).unwrap().translation.vector;
    let start = tip_at(&sim, &START);
    let mut farthest_m = 0.0_f64;
    for step in 0..50 {
        let verdict = decide_alone(&mut sim, step);
        let target = verdict.target().expect("the grip is held");
        farthest_m = farthest_m.max((tip_at(&sim, &target.position) - start).norm());
    }
    assert!(
        farthest_m > 0.5 * HAND_STEP_M && farthest_m < 1.5 * HAND_STEP_M,
        "{farthest_m}"
    );
    // Once the arm begins, it reaches the hand, which has rested since.
    for _ in 0..300 {
        sim.drive(Some(1), hand(49.0 * HAND_STEP_M, 0.0, 0.0));
    }
    let moved_m = (sim.tip().translation.vector - start).norm();
    assert!((moved_m - 49.0 * HAND_STEP_M).abs() < 1e-4, "{moved_m}");
}

/// Invariant: an arm that was moved by hand during a grip moves back only after a new grip.
#[test]
fn arm_that_was_moved_by_hand_needs_a_new_grip() {
    let mut sim = Sim::ready(ageless());
    for step in 0..3 {
        assert!(!is_braking(&decide_alone(&mut sim, step)));
    }
    sim.send(Some(1), hand(3.0 * HAND_STEP_M, 0.0, 0.0))
        .unwrap();
    sim.now += CYCLE;
    let mut arm = sim.arm();
    arm.position[0] += 1.0;
    let verdict = sim.steering.cycle(sim.now, &arm, sim.scene.as_ref());
    assert!(is_braking(&verdict), "{}", words(&verdict));
    let intent = hand(4.0 * HAND_STEP_M, 0.0, 0.0);
    assert!(sim.send(Some(1), intent).is_err(), "the grip is used up");
}
