//! Replies to the question whether a goal can be reached.

use serde::Serialize;

/// Whether the arm would reach a goal.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Preview {
    /// The result.
    pub verdict: PreviewVerdict,
    /// The result in one sentence.
    pub text: String,
    /// Joint positions at the goal, radians or meters, or the closest ones that were found.
    pub position: Option<Vec<f64>>,
    /// Where the goal is refused, meters in the frame of the arm's base.
    pub place: Option<[f64; 3]>,
}

/// Result of a preview.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub enum PreviewVerdict {
    /// The arm would move there.
    #[serde(rename = "reachable")]
    Reachable,
    /// No posture of the arm reaches the goal.
    #[serde(rename = "unreachable")]
    Unreachable,
    /// Parts of the robot would collide.
    #[serde(rename = "self-collision")]
    SelfCollision,
    /// The robot would come too close to a surface.
    #[serde(rename = "near")]
    Near,
    /// The robot would enter space that was never seen.
    #[serde(rename = "never seen")]
    NeverSeen,
    /// The goal is outside the workspace or the ranges of the joints.
    #[serde(rename = "limits")]
    Limits,
}
