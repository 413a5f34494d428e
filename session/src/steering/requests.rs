//! Translates requests of clients for the chain of decisions, and its answers for clients.

use super::time_base::TimeBase;
use steering::{Command, Device, Effect, Intent, Limit, Link, Operator};
use viz::{AppliedLimit, LimitEffect, LimitLink, RefusedRequest, SteeringCommand, SteeringIntent};
use viz::{ReceivedRequest, SteeredPart, SteeringRequest};

/// A command of a client, which has arrived with a request.
///
/// * `n_joints`: joints of the chain.
pub(super) fn command(
    received: &ReceivedRequest,
    command: &SteeringCommand,
    times: TimeBase,
    n_joints: usize,
) -> Command {
    // With an open switch, the intent has no effect, and clients may leave it out.
    let intent = command.intent.as_ref().map_or_else(
        || Intent::JointVelocity {
            velocity: vec![0.0; n_joints],
        },
        intent,
    );
    Command {
        operator: Operator(received.client),
        device: Device(command.device),
        sequence: command.sequence,
        captured_at: times.stamp(command.captured_at),
        received_at: times.stamp(received.received_at),
        grip: command.grip,
        intent,
    }
}

fn intent(intent: &SteeringIntent) -> Intent {
    match intent.clone() {
        SteeringIntent::Hand { base_from_hand } => Intent::Hand { base_from_hand },
        SteeringIntent::Pose { base_from_tip } => Intent::Pose { base_from_tip },
        SteeringIntent::Joints { position } => Intent::Joints { position },
        SteeringIntent::JointVelocity { velocity } => Intent::JointVelocity { velocity },
        SteeringIntent::TipVelocity {
            linear_m_s,
            angular_rad_s,
        } => Intent::TipVelocity {
            linear_m_s,
            angular_rad_s,
        },
        SteeringIntent::BaseVelocity {
            forward_m_s,
            left_m_s,
            yaw_rad_s,
        } => Intent::BaseVelocity {
            velocity: [forward_m_s, left_m_s, yaw_rad_s],
        },
        SteeringIntent::BaseGoal {
            x_m,
            y_m,
            heading_rad,
        } => Intent::BaseGoal {
            world_from_goal: [x_m, y_m, heading_rad],
        },
    }
}

/// The kind of a request, for its refusal. `None` if it is not refused.
pub(super) fn kind(request: &SteeringRequest) -> Option<RefusedRequest> {
    match request {
        SteeringRequest::TakeLease
        | SteeringRequest::RenewLease
        | SteeringRequest::ReleaseLease
        | SteeringRequest::OfferLease { .. } => Some(RefusedRequest::Lease),
        SteeringRequest::Stop => Some(RefusedRequest::Stop),
        SteeringRequest::Rearm { .. } => Some(RefusedRequest::Rearm),
        SteeringRequest::Command(_) => Some(RefusedRequest::Command),
        SteeringRequest::Preview(_) => Some(RefusedRequest::Preview),
        SteeringRequest::View { .. } | SteeringRequest::Disconnected => None,
    }
}

/// A limit as clients receive it.
///
/// * `part`: the part of the robot on which it acts.
pub(super) fn applied_limit(limit: &Limit, part: SteeredPart) -> AppliedLimit {
    let (effect, speed_scale) = match limit.effect {
        Effect::Slowed(scale) => (LimitEffect::Slowed, scale),
        Effect::Refused => (LimitEffect::Refused, 0.0),
        Effect::Braked => (LimitEffect::Braked, 0.0),
    };
    let link = match limit.link {
        Link::Lease => LimitLink::Lease,
        Link::Clutch => LimitLink::Clutch,
        Link::Limits => LimitLink::Limits,
        Link::SelfCollision => LimitLink::SelfCollision,
        Link::Clearance => LimitLink::Clearance,
        Link::Arm => LimitLink::Arm,
        Link::Base => LimitLink::Base,
    };
    AppliedLimit {
        part,
        link,
        effect,
        speed_scale,
        text: limit.reason.to_string(),
        place: limit.reason.place(),
    }
}
