//! Why a link of the chain slowed the arm down, refused a motion or stopped the arm.

use crate::request::{Device, Operator};
use serde::{Deserialize, Serialize};

/// A link of the chain, in the order in which they decide.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Link {
    /// Who may move the arm.
    Lease,
    /// Whether the operator wants the arm to move now.
    Clutch,
    /// How fast and how far the arm may move.
    Limits,
    /// Distance between parts of the robot.
    SelfCollision,
    /// Distance to the scene.
    Clearance,
    /// The arm itself, also while the base moves.
    Arm,
    /// The base itself.
    Base,
}

/// What a link did.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Effect {
    /// The motion is slower than requested: by this factor, 0 to 1.
    Slowed(f64),
    /// The motion, or a part of it, was refused. Other motions are possible with the same grip.
    Refused,
    /// The arm brakes. It does not move before a new grip.
    Braked,
}

/// A limit that was applied: a link, its effect and the reason.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Limit {
    /// The link.
    pub link: Link,
    /// What it did.
    pub effect: Effect,
    /// Why.
    pub reason: Reason,
}

impl std::fmt::Display for Limit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.effect {
            Effect::Slowed(scale) => write!(f, "slowed to {:.0} %: ", 100.0 * scale)?,
            Effect::Refused => write!(f, "refused: ")?,
            Effect::Braked => write!(f, "braking: ")?,
        }
        write!(f, "{}", self.reason)
    }
}

/// A motion, or a part of it, that a link refuses.
pub(crate) fn refused(link: Link, reason: Reason) -> Limit {
    Limit {
        link,
        effect: Effect::Refused,
        reason,
    }
}

/// A link because of which the robot is at rest.
pub(crate) fn braked(link: Link, reason: Reason) -> Limit {
    Limit {
        link,
        effect: Effect::Braked,
        reason,
    }
}

/// A reason in words. Places are points in the frame of the arm's base, in meters; for reasons
/// of a base, they are in the world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, thiserror::Error)]
pub enum Reason {
    /// Nobody holds the lease.
    #[error("nobody has control: take control first")]
    NoLease,
    /// Another operator holds the lease.
    #[error("{holder} has control for at least {left_secs:.1} s more: ask for it")]
    LeaseHeld {
        /// Holder of the lease.
        holder: Operator,
        /// Time until the lease expires if its holder is silent.
        left_secs: f64,
    },
    /// The lease expired, because its holder was silent.
    #[error("control of {holder} expired after {silent_secs:.1} s of silence")]
    LeaseExpired {
        /// Former holder of the lease.
        holder: Operator,
        /// Duration of the silence.
        silent_secs: f64,
    },
    /// The holder gave the lease back, or another operator took it after an offer.
    #[error("{holder} gave up control")]
    LeaseGivenUp {
        /// Former holder of the lease.
        holder: Operator,
    },
    /// An operator stopped the arm.
    #[error("stopped by {operator}: check the arm, then permit motion again")]
    StoppedBy {
        /// The operator.
        operator: Operator,
    },
    /// A program stopped the arm.
    #[error("stopped by the program: check the arm, then permit motion again")]
    StoppedByProgram,
    /// A permission was given after another stop than the newest.
    #[error(
        "this permits motion after stop {named}, but the newest is stop {newest}: check the arm, \
         then permit motion again"
    )]
    OtherStop {
        /// Number of the stop in the request.
        named: u64,
        /// Number of the newest stop.
        newest: u64,
    },
    /// The model of the scene has failed.
    #[error("nothing is known about the scene any more: {report}")]
    SceneLost {
        /// Why.
        report: String,
    },
    /// The arm reports a fault.
    #[error("the arm stopped: {report}; recover the arm, then permit motion again")]
    ArmStopped {
        /// Report of the arm.
        report: String,
    },
    /// The arm reports no state.
    #[error("the arm has reported no state for {silent_secs:.3} s")]
    ArmSilent {
        /// Time since the last report.
        silent_secs: f64,
    },
    /// The report of the arm cannot be used.
    #[error("the arm reported {report}")]
    ArmReport {
        /// What is wrong.
        report: String,
    },
    /// The arm braked without an order, because its target expired or had no trajectory.
    #[error("the arm braked, because its target expired or had no trajectory: grip again")]
    ArmBraked,
    /// The time went back.
    #[error("the clock went back by {secs:.3} s")]
    ClockWentBack {
        /// By how much.
        secs: f64,
    },
    /// The dead-man switch is open.
    #[error("the dead-man switch is open")]
    NotGripped,
    /// The dead-man switch was closed before motion was permitted.
    #[error("grip {grip} of {device} is used up: open and close the dead-man switch")]
    GripUsedUp {
        /// Device.
        device: Device,
        /// Number of the grip.
        grip: u64,
    },
    /// Another device of the operator moves the arm.
    #[error("{active} moves the arm: open its dead-man switch before using {device}")]
    AnotherDevice {
        /// The device that was refused.
        device: Device,
        /// The device that moves the arm.
        active: Device,
    },
    /// The device with the closed switch is silent.
    #[error("{device} was silent for {silent_secs:.3} s: grip again")]
    DeviceSilent {
        /// Device.
        device: Device,
        /// Duration of the silence.
        silent_secs: f64,
    },
    /// A command is too old.
    #[error("the command is {age_secs:.3} s old, at most {max_secs:.3} s are accepted")]
    Stale {
        /// Age of the command.
        age_secs: f64,
        /// Greatest age accepted.
        max_secs: f64,
    },
    /// A command comes from the future.
    #[error("the command is stamped {ahead_secs:.3} s ahead: the clocks differ")]
    FromFuture {
        /// How far in the future.
        ahead_secs: f64,
    },
    /// A command was repeated or overtaken by a newer one.
    #[error("command {sequence} came after command {newest}")]
    OutOfOrder {
        /// Number of the command.
        sequence: u64,
        /// Greatest number received.
        newest: u64,
    },
    /// A command has a number that is not finite, or no rotation.
    #[error("the command's {what} is not finite or not a rotation")]
    NotFinite {
        /// Kind of the intent.
        what: String,
    },
    /// A command has a wrong number of joints.
    #[error("the command has {got} joints, the arm has {expected}")]
    JointCount {
        /// Number of joints in the command.
        got: usize,
        /// Number of joints of the arm.
        expected: usize,
    },
    /// The hand jumped, for example because the headset moved its origin.
    #[error("the hand jumped by {distance_m:.2} m and {angle_rad:.1} rad: grip again")]
    HandJumped {
        /// Distance between two samples.
        distance_m: f64,
        /// Angle between two samples.
        angle_rad: f64,
    },
    /// The arm is not yet at rest after the last grip.
    #[error("the arm is still braking")]
    StillBraking,
    /// The tip would move too fast.
    #[error("the tip would move too fast")]
    TipSpeed,
    /// A joint would move too fast, for example near a singular posture.
    #[error("joint {joint} would move too fast")]
    JointSpeed {
        /// Name of the joint.
        joint: String,
    },
    /// A part of the robot would move too fast.
    #[error("{part} would move too fast")]
    PartSpeed {
        /// Link of the robot.
        part: String,
        /// Place of the part.
        place: [f64; 3],
    },
    /// The arm is too far behind its target.
    #[error("joint {joint} is {lag:.3} behind its target")]
    Lag {
        /// Name of the joint.
        joint: String,
        /// Distance, radians or meters.
        lag: f64,
    },
    /// The goal is outside the workspace box.
    #[error("the goal is outside the workspace")]
    Workspace {
        /// The goal.
        place: [f64; 3],
    },
    /// A joint would leave its range.
    #[error("joint {joint} is at the end of its range")]
    JointRange {
        /// Name of the joint.
        joint: String,
    },
    /// No posture within the ranges has the pose.
    #[error("no posture of the arm reaches this pose")]
    Unreachable {
        /// Position of the tip in this pose.
        place: [f64; 3],
    },
    /// The pose needs another posture.
    #[error("joint {joint} would jump by {step:.2}: the pose needs another posture")]
    OtherPosture {
        /// Name of the joint.
        joint: String,
        /// Distance, radians or meters.
        step: f64,
    },
    /// Two parts of the robot are close to each other.
    #[error("{} and {} are {:.0} mm apart", .parts[0], .parts[1], 1000.0 * .distance_m)]
    SelfCollision {
        /// Both links.
        parts: [String; 2],
        /// Distance; negative if the enclosing capsules overlap.
        distance_m: f64,
        /// Point between both.
        place: [f64; 3],
    },
    /// A surface of the scene is near.
    #[error("{part} is {:.0} mm from a surface, which was seen {age_secs:.0} s ago", 1000.0 * .distance_m)]
    Near {
        /// Link of the robot.
        part: String,
        /// Distance from its surface.
        distance_m: f64,
        /// Time since the region was seen.
        age_secs: f64,
        /// Place of the part.
        place: [f64; 3],
    },
    /// The region has not been seen for a long time.
    #[error("the space around {part} was last seen {age_secs:.0} s ago")]
    LongUnseen {
        /// Link of the robot.
        part: String,
        /// Time since the region was seen.
        age_secs: f64,
        /// Place of the part.
        place: [f64; 3],
    },
    /// The region has never been seen.
    #[error("the space around {part} has never been seen")]
    NeverSeen {
        /// Link of the robot.
        part: String,
        /// Place of the part.
        place: [f64; 3],
    },
    /// A command for a base, but only an arm is steered.
    #[error("no base is steered in this run: the command would move one")]
    NoBase,
    /// A command for an arm, but only a base is steered.
    #[error("only the base is steered in this run: the command would move an arm")]
    OnlyBase,
    /// A command for the other part of the robot than its grip.
    #[error("this grip moves another part of the robot: let go, and grip again")]
    OtherPart,
    /// The arm rests while its operator moves the base.
    #[error("the base is being moved, so the arm rests")]
    BaseHasGrip,
    /// The base rests while its operator moves the arm.
    #[error("the arm is being moved, so the base rests")]
    ArmHasGrip,
    /// The base under the arm moves.
    #[error("the base under the arm is moving")]
    BaseMoves,
    /// Something that is not known to be free is close to the base, or on its way.
    #[error(
        "something is {:.0} mm from the base on its way: a surface, or space that was never seen",
        1000.0 * .distance_m
    )]
    BaseNear {
        /// Distance from the footprint; negative if it is inside.
        distance_m: f64,
        /// A point of the footprint there.
        place: [f64; 3],
    },
    /// The base reports a fault.
    #[error("the base stopped: {report}; clear the fault, then permit motion again")]
    BaseStopped {
        /// Report of the base.
        report: String,
    },
    /// The base reports no state.
    #[error("the base has reported no state for {silent_secs:.3} s")]
    BaseSilent {
        /// Time since the last report.
        silent_secs: f64,
    },
    /// The base refused a velocity.
    #[error("the base refused the velocity: {report}")]
    BaseRefused {
        /// Report of the base.
        report: String,
    },
    /// The base braked without an order, because its target expired.
    #[error("the base braked, because its target expired: grip again")]
    BaseBraked,
    /// The base is not yet at rest after the last grip.
    #[error("the base is still braking")]
    BaseStillBraking,
    /// The base would move too fast.
    #[error("the base would move too fast")]
    BaseSpeed,
    /// The base cannot move sideways.
    #[error("the base cannot move sideways")]
    NoSideways,
    /// The pose of the base is needed, but not known.
    #[error("the pose of the base has not been known for the last {max_age_secs} s")]
    BasePoseUnknown {
        /// Greatest age of a pose that counts.
        max_age_secs: f64,
    },
    /// The base is close to the edge of its area.
    #[error("the base is close to the edge of its area")]
    AreaEdge {
        /// Place of the base.
        place: [f64; 3],
    },
    /// The goal is outside the area of the base.
    #[error("the goal is outside the area of the base")]
    GoalOutsideArea {
        /// The goal.
        place: [f64; 3],
    },
    /// The posture of the arm on the base is not known.
    #[error("the posture of the arm is not known: the base moves only while it is stowed")]
    ArmUnknown,
    /// The arm on the base is not stowed.
    #[error(
        "joint {joint} is {offset:.2} from its stowed position: stow the arm before the base moves"
    )]
    ArmNotStowed {
        /// Name of the joint.
        joint: String,
        /// Distance, radians or meters.
        offset: f64,
    },
}

impl Reason {
    /// The place of the reason in the frame of the arm's base, or in the world for reasons of a
    /// base, meters.
    pub fn place(&self) -> Option<[f64; 3]> {
        match self {
            Self::PartSpeed { place, .. }
            | Self::Workspace { place }
            | Self::Unreachable { place }
            | Self::SelfCollision { place, .. }
            | Self::Near { place, .. }
            | Self::LongUnseen { place, .. }
            | Self::NeverSeen { place, .. }
            | Self::BaseNear { place, .. }
            | Self::AreaEdge { place }
            | Self::GoalOutsideArea { place } => Some(*place),
            _ => None,
        }
    }
}
