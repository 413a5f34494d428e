//! Says whether the arm could reach a goal, before it moves.

use kinematics::inverse::{InverseSolver, Target, Unsolved};
use kinematics::{Stamp, transform};
use steering::{Clearance, Limit, Link, Reason, Steering};
use viz::{Preview, PreviewGoal, PreviewVerdict};

/// Finds postures for goals.
#[derive(Debug)]
pub(super) struct Previews {
    solver: InverseSolver,
}

/// What a preview is compared with.
pub(super) struct Now<'a> {
    pub(super) steering: &'a Steering,
    pub(super) scene: &'a dyn Clearance,
    pub(super) at: Stamp,
    /// Joint values of the arm.
    pub(super) position: &'a [f64],
}

impl Previews {
    /// * `solver`: within the ranges in which operators may move the arm.
    pub(super) fn new(solver: InverseSolver) -> Self {
        Self { solver }
    }

    /// Checks a goal. The way to it is not checked.
    pub(super) fn answer(&mut self, goal: &PreviewGoal, now: &Now<'_>) -> Preview {
        match goal {
            PreviewGoal::Joints { position } => judge(position.clone(), now),
            PreviewGoal::Pose { base_from_tip } => {
                let pose = transform::from_xyz_xyzw(*base_from_tip);
                match self.solver.solve(&Target::pose(pose), now.position) {
                    Ok(position) => judge(position, now),
                    Err(unsolved) => unreachable(&unsolved, *base_from_tip),
                }
            }
        }
    }
}

fn judge(position: Vec<f64>, now: &Now<'_>) -> Preview {
    match now.steering.check_posture(now.at, &position, now.scene) {
        Ok(()) => Preview {
            verdict: PreviewVerdict::Reachable,
            text: "the arm can reach this goal".to_owned(),
            position: Some(position),
            place: None,
        },
        Err(limit) => Preview {
            verdict: verdict(&limit),
            text: limit.reason.to_string(),
            position: Some(position),
            place: limit.reason.place(),
        },
    }
}

fn verdict(limit: &Limit) -> PreviewVerdict {
    match (limit.link, &limit.reason) {
        (Link::SelfCollision, _) => PreviewVerdict::SelfCollision,
        (Link::Clearance, Reason::NeverSeen { .. }) => PreviewVerdict::NeverSeen,
        (Link::Clearance, _) => PreviewVerdict::Near,
        _ => PreviewVerdict::Limits,
    }
}

fn unreachable(unsolved: &Unsolved, goal: [f64; 7]) -> Preview {
    let [x, y, z, ..] = goal;
    Preview {
        verdict: PreviewVerdict::Unreachable,
        text: unsolved.to_string(),
        position: unsolved.nearest().map(|nearest| nearest.joints.clone()),
        place: Some([x, y, z]),
    }
}
