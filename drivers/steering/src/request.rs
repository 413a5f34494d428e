//! What operators ask for.
//!
//! All poses and velocities are in axes of the arm's base, because a correction of the map or of
//! the base's pose must not move a goal. A caller that maps a hand into these axes, for example "as
//! seen by the camera", must keep the map while the dead-man switch is held.

use drivers::motion::exact;
use kinematics::{Stamp, Transform, transform};
use serde::{Deserialize, Serialize};

/// An operator. The server numbers the connections; no number is used twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Operator(pub u64);

impl std::fmt::Display for Operator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "operator {}", self.0)
    }
}

/// A source of commands of an operator, such as a controller, a gamepad or a page. A page that is
/// loaded again is another device, because it counts from the beginning again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Device(pub u64);

impl std::fmt::Display for Device {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "device {}", self.0)
    }
}

/// A request of an operator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Request {
    /// Take the lease if nobody holds it, or if its holder offers it to this operator.
    TakeLease(Operator),
    /// Keep the lease without moving the arm.
    RenewLease(Operator),
    /// Give the lease back.
    ReleaseLease(Operator),
    /// Offer the lease to another operator, who takes it with [`Request::TakeLease`].
    OfferLease {
        /// Holder of the lease.
        from: Operator,
        /// The operator who may take it.
        to: Operator,
    },
    /// Brake, and stay at rest until [`Request::Rearm`]. Everybody may stop the arm.
    Stop {
        /// Who stopped the arm; `None` for a program.
        by: Option<Operator>,
    },
    /// Brake, and stay at rest until [`Request::Rearm`], because nothing is known about the scene
    /// any more. [`Steering::decide`](crate::Steering::decide) makes this request for
    /// [`Clearance::failure`](crate::Clearance::failure), so that the record contains it.
    SceneLost {
        /// Why, in words.
        report: String,
    },
    /// Permit motion after a stop. Only the holder of the lease may do this, and only because a
    /// person asked for it. The arm does not move before a new grip.
    Rearm {
        /// Holder of the lease.
        operator: Operator,
        /// Number of the newest stop that the person has seen ([`Authority::stop_number`]). A
        /// permission must not undo a stop that came after it was given.
        ///
        /// [`Authority::stop_number`]: crate::Authority::stop_number
        stop: u64,
    },
    /// Move the arm.
    Command(Command),
}

/// One sample of a device that moves the arm. A device sends samples continuously, also while its
/// dead-man switch is open.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Command {
    /// Sender.
    pub operator: Operator,
    /// Device of the sender.
    pub device: Device,
    /// Number of the sample. It increases with every sample of the device.
    pub sequence: u64,
    /// When the device was read, on the clock of the chain. The caller converts the device's time.
    #[serde(with = "exact::stamp")]
    pub captured_at: Stamp,
    /// When the command arrived at this program. The silence of the device counts from here, so
    /// that a command that waited for a decision does not look fresh.
    #[serde(with = "exact::stamp")]
    pub received_at: Stamp,
    /// Number of the grip: how often the dead-man switch has been closed since the device started.
    /// `None` while it is open. A count instead of a flag shows a release whose message was lost.
    pub grip: Option<u64>,
    /// Where to move while the switch is closed.
    pub intent: Intent,
}

impl Command {
    /// When the command arrived, but not after it is decided: clocks are rounded.
    pub(crate) fn received_by(&self, now: Stamp) -> Stamp {
        self.received_at.min(now)
    }
}

/// Where the arm should move.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Intent {
    /// The tip follows the hand: it makes the same motion as the hand since the start of the grip.
    Hand {
        /// Pose of the hand in axes of the base: x, y, z in meters, and a quaternion x, y, z, w.
        /// The origin is arbitrary.
        #[serde(with = "exact::array")]
        base_from_hand: [f64; 7],
    },
    /// The tip moves to a pose.
    Pose {
        /// Pose of the tip: x, y, z in meters, and a quaternion x, y, z, w.
        #[serde(with = "exact::array")]
        base_from_tip: [f64; 7],
    },
    /// The joints move to positions.
    Joints {
        /// Radians or meters, in the order of the chain.
        #[serde(with = "exact::list")]
        position: Vec<f64>,
    },
    /// The joints move at velocities.
    JointVelocity {
        /// Radians or meters per second, in the order of the chain.
        #[serde(with = "exact::list")]
        velocity: Vec<f64>,
    },
    /// The tip moves at a velocity, in axes of the base.
    TipVelocity {
        /// Velocity of the tip's origin.
        #[serde(with = "exact::array")]
        linear_m_s: [f64; 3],
        /// Angular velocity of the tip.
        #[serde(with = "exact::array")]
        angular_rad_s: [f64; 3],
    },
    /// The base moves at a velocity, in its own frame.
    BaseVelocity {
        /// Forward and left in m/s, and the yaw rate in rad/s.
        #[serde(with = "exact::array")]
        velocity: [f64; 3],
    },
    /// The base moves to a pose on the floor.
    BaseGoal {
        /// x and y in meters and the heading in radians, in the world.
        #[serde(with = "exact::array")]
        world_from_goal: [f64; 3],
    },
}

impl Intent {
    /// Whether the intent is a motion of a base.
    pub(crate) fn is_of_base(&self) -> bool {
        matches!(self, Self::BaseVelocity { .. } | Self::BaseGoal { .. })
    }

    /// Name of the kind, for messages.
    pub(crate) fn kind(&self) -> &'static str {
        match self {
            Self::Hand { .. } => "hand pose",
            Self::Pose { .. } => "tip pose",
            Self::Joints { .. } => "joint positions",
            Self::JointVelocity { .. } => "joint velocities",
            Self::TipVelocity { .. } => "tip velocity",
            Self::BaseVelocity { .. } => "base velocity",
            Self::BaseGoal { .. } => "base goal",
        }
    }

    /// The numbers of the intent.
    pub(crate) fn numbers(&self) -> Vec<f64> {
        match self {
            Self::Hand { base_from_hand } => base_from_hand.to_vec(),
            Self::Pose { base_from_tip } => base_from_tip.to_vec(),
            Self::Joints { position } => position.clone(),
            Self::JointVelocity { velocity } => velocity.clone(),
            Self::TipVelocity {
                linear_m_s,
                angular_rad_s,
            } => [*linear_m_s, *angular_rad_s].concat(),
            Self::BaseVelocity { velocity: numbers }
            | Self::BaseGoal {
                world_from_goal: numbers,
            } => numbers.to_vec(),
        }
    }

    /// Number of joint values, if the intent has any.
    pub(crate) fn n_joints(&self) -> Option<usize> {
        match self {
            Self::Joints { position: values } | Self::JointVelocity { velocity: values } => {
                Some(values.len())
            }
            _ => None,
        }
    }

    /// The pose in the intent, if it has one; see [`pose`].
    pub(crate) fn pose(&self) -> Option<Option<Transform>> {
        match self {
            Self::Hand {
                base_from_hand: numbers,
            }
            | Self::Pose {
                base_from_tip: numbers,
            } => Some(pose(numbers)),
            _ => None,
        }
    }
}

/// The pose of seven numbers. `None` if they are no pose: senders round quaternions, but a
/// quaternion far from unit length is a bug of the sender.
pub(crate) fn pose(numbers: &[f64; 7]) -> Option<Transform> {
    const MAX_ROUNDING: f64 = 1e-3;
    let mut pose = transform::from_xyz_xyzw(*numbers);
    let norm = pose.rotation.into_inner().norm();
    // The comparison is written so that NaN fails.
    let is_rotation = (norm - 1.0).abs() <= MAX_ROUNDING;
    if !is_rotation || !transform::is_finite(&pose) {
        return None;
    }
    pose.rotation.renormalize();
    Some(pose)
}
