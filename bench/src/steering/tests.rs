//! The whole bench, with one trial per fault.

use super::*;

#[test]
fn one_trial_of_each_fault_brakes_the_arm_within_its_limits() {
    let folder = tempfile::tempdir().expect("a folder");
    let options = SteeringOptions {
        arms: vec![ArmKind::Simulated],
        faults: Fault::ALL.to_vec(),
        n_trials: 1,
        tracking_secs: 2.0,
        n_poses: 0,
        n_grips: 0,
        n_goals: 0,
        views: None,
        processes: None,
        out: folder.path().to_owned(),
    };
    let mut rows = Vec::new();
    let result = run(&options, |row| {
        rows.push(row.clone());
        Ok(())
    })
    .expect("the arm is steered");
    // Without a program, nothing is stopped or killed.
    let n_faults = Fault::ALL.iter().filter(|fault| !fault.ends_program());
    assert_eq!(rows.len(), n_faults.count());
    for row in &rows {
        // On a busy computer, no trial may come to its fault.
        if row.n_trials == 0 {
            continue;
        }
        assert_eq!((row.n_exceeded, row.n_not_at_rest), (0, 0), "{row:?}");
        // The fault comes first, then the brake, then the rest. How fast is a result, not a test. An
        // arm may arrive at its last target before it brakes because of silence.
        let begins = row.begins.worst_millis.expect("it brakes");
        let rests = row.rests.worst_millis.expect("it comes to rest");
        assert!(begins >= 0.0 && rests >= begins, "{row:?}");
    }
    let n_measured = rows.iter().filter(|row| row.n_trials > 0).count();
    assert!(n_measured > 0, "no fault was tried: {rows:?}");
    assert!(result.page.is_file());
    for name in [
        "steering.json",
        "steering-faults.svg",
        "steering-faults.png",
    ] {
        assert!(folder.path().join(name).is_file(), "{name}");
    }
}
