//! What clients ask for, after the server has checked it.
//!
//! All poses are in the frame of the arm's base: x, y, z in meters, and a quaternion x, y, z, w of
//! unit length within 0.001. All numbers are finite, and lists of joint values have one value per
//! joint of the [`ArmDescription`](crate::ArmDescription).

use serde::Serialize;
use std::time::Instant;

/// A request with its sender.
#[derive(Clone, Debug, PartialEq)]
pub struct ReceivedRequest {
    /// Number of the sender's connection. No number is used twice, also not by `/ws`.
    pub client: u64,
    /// When the server read the request.
    pub received_at: Instant,
    /// What the client asks for.
    pub request: SteeringRequest,
}

/// A request of a client. Viewers send only [`SteeringRequest::Stop`].
#[derive(Clone, Debug, PartialEq)]
pub enum SteeringRequest {
    /// Take the lease.
    TakeLease,
    /// Keep the lease without moving the arm.
    RenewLease,
    /// Give the lease back.
    ReleaseLease,
    /// Offer the lease to another client.
    OfferLease {
        /// Number of the other client.
        to: u64,
    },
    /// Brake, and stay at rest.
    Stop,
    /// Permit motion after a stop.
    Rearm {
        /// Number of the newest stop that the client has seen, as in
        /// [`SteeringState::stop_number`](crate::SteeringState::stop_number).
        stop: u64,
    },
    /// Move the arm.
    Command(SteeringCommand),
    /// Say whether a goal can be reached, without moving the arm.
    Preview(PreviewRequest),
    /// View of the operator, for the log of the run.
    View {
        /// Pose of the eye in the world. The camera is x right, y down, z forward.
        world_from_camera: [f64; 7],
    },
    /// The client has left, or has sent nothing for as long as a lease lasts. Whatever it held is
    /// released. A client that was only silent may send further requests.
    Disconnected,
}

/// One sample of a device.
#[derive(Clone, Debug, PartialEq)]
pub struct SteeringCommand {
    /// Number of the device, chosen by the client.
    pub device: u64,
    /// Number of the sample, below 2^53. While `grip` is a number, it increases with each command of
    /// the device.
    pub sequence: u64,
    /// When the device was read, as the client says.
    pub captured_at: Instant,
    /// Number of the grip; `None` while the dead-man switch is open.
    pub grip: Option<u64>,
    /// Where to move. It is never `None` while `grip` is a number.
    pub intent: Option<SteeringIntent>,
}

/// Where the arm or the base should move.
#[derive(Clone, Debug, PartialEq)]
pub enum SteeringIntent {
    /// The tip makes the same motion as the hand since the start of the grip.
    Hand {
        /// Pose of the hand. The origin is arbitrary.
        base_from_hand: [f64; 7],
    },
    /// The tip moves to a pose.
    Pose {
        /// Pose of the tip.
        base_from_tip: [f64; 7],
    },
    /// The joints move to positions.
    Joints {
        /// Radians or meters.
        position: Vec<f64>,
    },
    /// The joints move at velocities.
    JointVelocity {
        /// Radians or meters per second.
        velocity: Vec<f64>,
    },
    /// The tip moves at a velocity.
    TipVelocity {
        /// Velocity of the tip's origin.
        linear_m_s: [f64; 3],
        /// Angular velocity of the tip.
        angular_rad_s: [f64; 3],
    },
    /// The base moves at a velocity, in its own frame.
    BaseVelocity {
        /// Forward, m/s.
        forward_m_s: f64,
        /// To the left, m/s.
        left_m_s: f64,
        /// Counterclockwise seen from above, rad/s.
        yaw_rad_s: f64,
    },
    /// The base moves to a pose on the floor of the world.
    BaseGoal {
        /// x of the base link, meters.
        x_m: f64,
        /// y of the base link, meters.
        y_m: f64,
        /// Direction of its x axis, counterclockwise from the x axis of the world.
        heading_rad: f64,
    },
}

/// A goal to check.
#[derive(Clone, Debug, PartialEq)]
pub struct PreviewRequest {
    /// Number chosen by the client, for [`SteeringServer::answer_preview`](crate::SteeringServer::answer_preview).
    pub id: u64,
    /// The goal.
    pub goal: PreviewGoal,
}

/// Where the arm would move.
#[derive(Clone, Debug, PartialEq)]
pub enum PreviewGoal {
    /// The tip would move to a pose.
    Pose {
        /// Pose of the tip.
        base_from_tip: [f64; 7],
    },
    /// The joints would move to positions.
    Joints {
        /// Radians or meters.
        position: Vec<f64>,
    },
}

/// The kind of a request that was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RefusedRequest {
    /// Taking, renewing, releasing or offering the lease.
    Lease,
    /// A stop.
    Stop,
    /// Permitting motion after a stop.
    Rearm,
    /// A command.
    Command,
    /// A preview.
    Preview,
    /// A message that is none of these, or cannot be read.
    Message,
}
