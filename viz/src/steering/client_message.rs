//! Messages from clients of `/steer`, as in `docs/reference/protocol.md`.
//!
//! Unknown fields are ignored, so that newer pages can steer. Everything else is checked here: a
//! number that is too large, a list of the wrong length or a time of another clock is refused with
//! a sentence, and the connection stays open.

use crate::clock::ServerClock;
use crate::server::access::Role;
use crate::steering::request::{
    PreviewGoal, PreviewRequest, RefusedRequest, SteeringCommand, SteeringIntent, SteeringRequest,
};
use serde::Deserialize;
use std::time::{Duration, Instant};

/// Maximum length of a message, bytes. A command for an arm with 30 joints has less than 1 kB.
pub(crate) const MAX_MESSAGE_BYTES: usize = 4 * 1024;
/// Greatest integer that JavaScript represents exactly.
const MAX_INTEGER: u64 = (1 << 53) - 1;
/// Greatest absolute value of positions, angles and velocities. No arm needs more, and sums and
/// products of such numbers stay finite.
const MAX_NUMBER: f64 = 1e6;
/// Greatest difference between the time of a command and the server's clock. Commands of more than
/// a fraction of a second are too old to be obeyed anyway. A larger difference shows that the client
/// uses another clock.
const MAX_CLOCK_DIFFERENCE_SECS: f64 = 10.0;
/// Greatest deviation of the length of a quaternion from 1: clients round its numbers.
const MAX_ROUNDING: f64 = 1e-3;
/// Maximum length of a refusal, characters.
const MAX_TEXT_CHARS: usize = 300;

/// What a client asks for.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ClientRequest {
    /// A request for the loop.
    Steering(SteeringRequest),
    /// A request for the server's time.
    Ping { id: u64 },
}

/// Why a message is refused.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Refusal {
    /// The kind of the message.
    pub(crate) request: RefusedRequest,
    /// The reason in one sentence.
    pub(crate) text: String,
}

/// What is needed to check messages.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MessageContext {
    pub(crate) role: Role,
    pub(crate) clock: ServerClock,
    pub(crate) n_joints: usize,
}

/// Reads and checks a message that was received at a time.
pub(crate) fn read_message(
    text: &str,
    received_at: Instant,
    context: MessageContext,
) -> Result<ClientRequest, Refusal> {
    let kind = kind_of(text);
    let kind = kind.as_deref();
    read_kind(kind, text, received_at, context).map_err(|error| Refusal {
        request: refused_kind(kind),
        text: sentence(&error.to_string()),
    })
}

/// An error as one line of limited length, because errors repeat parts of the message.
fn sentence(error: &str) -> String {
    let printable = error.chars().map(|c| if c.is_control() { ' ' } else { c });
    printable.take(MAX_TEXT_CHARS).collect()
}

/// Why a message is refused, in one sentence.
#[derive(Debug, thiserror::Error)]
enum MessageError {
    #[error("the message is not valid: {0}")]
    Json(#[from] serde_json::Error),
    #[error(
        "unknown type {0:?}, expected \"lease\", \"stop\", \"rearm\", \"command\", \"preview\", \"view\" or \"ping\""
    )]
    UnknownType(String),
    #[error("the message has no type: it must be a JSON object with the field \"type\"")]
    NoType,
    #[error("steering requires the role operator: viewers can only watch and stop the arm")]
    NotOperator,
    #[error("{name} is {got}, expected at most {MAX_INTEGER}")]
    LargeInteger { name: &'static str, got: u64 },
    #[error("{name} contains {got}, expected numbers between -{MAX_NUMBER} and {MAX_NUMBER}")]
    LargeNumber { name: &'static str, got: f64 },
    #[error("{name} has {got} values, the arm has {expected} joints")]
    JointCount {
        name: &'static str,
        got: usize,
        expected: usize,
    },
    #[error("the quaternion of {name} has the length {got:.3}, expected 1")]
    Quaternion { name: &'static str, got: f64 },
    #[error(
        "captured_micros differs from the server's clock by {difference_secs:.1} s, at most \
         {MAX_CLOCK_DIFFERENCE_SECS} s are accepted: estimate the server's clock with ping"
    )]
    Clock { difference_secs: f64 },
    #[error("rearm needs stop: the stop_number of the state that the operator has seen")]
    NoStop,
    #[error("a command with a grip needs an intent")]
    NoIntent,
    #[error("a preview needs either base_from_tip or position")]
    PreviewGoal,
}

/// Fields of `lease`.
#[derive(Debug, Deserialize)]
#[serde(tag = "action", rename_all = "snake_case")]
enum LeaseMessage {
    Take,
    Renew,
    Release,
    Offer { to: u64 },
}

/// Fields of `rearm`.
#[derive(Debug, Deserialize)]
struct RearmMessage {
    stop: Option<u64>,
}

/// Fields of `command`.
#[derive(Debug, Deserialize)]
struct CommandMessage {
    device: u64,
    sequence: u64,
    captured_micros: f64,
    grip: Option<u64>,
    intent: Option<IntentMessage>,
}

/// The intent of a command.
#[derive(Debug, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
enum IntentMessage {
    Hand {
        base_from_hand: [f64; 7],
    },
    Pose {
        base_from_tip: [f64; 7],
    },
    Joints {
        position: Vec<f64>,
    },
    JointVelocity {
        velocity: Vec<f64>,
    },
    TipVelocity {
        linear_m_s: [f64; 3],
        angular_rad_s: [f64; 3],
    },
    BaseVelocity {
        forward_m_s: f64,
        left_m_s: f64,
        yaw_rad_s: f64,
    },
    BaseGoal {
        x_m: f64,
        y_m: f64,
        heading_rad: f64,
    },
}

/// Fields of `preview`.
#[derive(Debug, Deserialize)]
struct PreviewMessage {
    id: u64,
    base_from_tip: Option<[f64; 7]>,
    position: Option<Vec<f64>>,
}

/// Fields of `view`.
#[derive(Debug, Deserialize)]
struct ViewMessage {
    world_from_camera: [f64; 7],
}

/// Fields of `ping`.
#[derive(Debug, Deserialize)]
struct PingMessage {
    id: u64,
}

/// The type of a message; `None` if it has none.
///
/// It is read first and alone, so that nothing else in a message can keep a stop from being obeyed.
fn kind_of(text: &str) -> Option<String> {
    #[derive(Deserialize)]
    struct Typed {
        r#type: String,
    }
    serde_json::from_str::<Typed>(text)
        .ok()
        .map(|typed| typed.r#type)
}

fn refused_kind(kind: Option<&str>) -> RefusedRequest {
    match kind {
        Some("lease") => RefusedRequest::Lease,
        Some("stop") => RefusedRequest::Stop,
        Some("rearm") => RefusedRequest::Rearm,
        Some("command") => RefusedRequest::Command,
        Some("preview") => RefusedRequest::Preview,
        _ => RefusedRequest::Message,
    }
}

fn read_kind(
    kind: Option<&str>,
    text: &str,
    received_at: Instant,
    context: MessageContext,
) -> Result<ClientRequest, MessageError> {
    // What everybody may do. Everything below these two requires an operator.
    match kind {
        Some("stop") => return Ok(ClientRequest::Steering(SteeringRequest::Stop)),
        Some("ping") => {
            let PingMessage { id } = serde_json::from_str(text)?;
            let id = integer("id", id)?;
            return Ok(ClientRequest::Ping { id });
        }
        _ => {}
    }
    let is_known = refused_kind(kind) != RefusedRequest::Message || kind == Some("view");
    if is_known && context.role < Role::Operator {
        return Err(MessageError::NotOperator);
    }
    let request = match kind {
        Some("lease") => lease(serde_json::from_str(text)?)?,
        Some("rearm") => rearm(&serde_json::from_str(text)?)?,
        Some("command") => {
            let message = serde_json::from_str(text)?;
            SteeringRequest::Command(command(message, received_at, context)?)
        }
        Some("preview") => {
            let message = serde_json::from_str(text)?;
            SteeringRequest::Preview(preview(message, context.n_joints)?)
        }
        Some("view") => {
            let ViewMessage { world_from_camera } = serde_json::from_str(text)?;
            SteeringRequest::View {
                world_from_camera: pose("world_from_camera", world_from_camera)?,
            }
        }
        Some(other) => return Err(MessageError::UnknownType(other.to_owned())),
        None => return Err(MessageError::NoType),
    };
    Ok(ClientRequest::Steering(request))
}

fn lease(message: LeaseMessage) -> Result<SteeringRequest, MessageError> {
    Ok(match message {
        LeaseMessage::Take => SteeringRequest::TakeLease,
        LeaseMessage::Renew => SteeringRequest::RenewLease,
        LeaseMessage::Release => SteeringRequest::ReleaseLease,
        LeaseMessage::Offer { to } => SteeringRequest::OfferLease {
            to: integer("to", to)?,
        },
    })
}

fn rearm(message: &RearmMessage) -> Result<SteeringRequest, MessageError> {
    let stop = message.stop.ok_or(MessageError::NoStop)?;
    Ok(SteeringRequest::Rearm {
        stop: integer("stop", stop)?,
    })
}

fn command(
    message: CommandMessage,
    received_at: Instant,
    context: MessageContext,
) -> Result<SteeringCommand, MessageError> {
    let device = integer("device", message.device)?;
    let captured_at = captured_at(message.captured_micros, received_at, context.clock);
    let Some(grip) = message.grip else {
        // An open switch is obeyed even if the rest of the command is wrong.
        return Ok(SteeringCommand {
            device,
            sequence: message.sequence.min(MAX_INTEGER),
            captured_at: captured_at.unwrap_or(received_at),
            grip: None,
            intent: message
                .intent
                .and_then(|intent| check_intent(intent, context.n_joints).ok()),
        });
    };
    let intent = message.intent.ok_or(MessageError::NoIntent)?;
    Ok(SteeringCommand {
        device,
        sequence: integer("sequence", message.sequence)?,
        captured_at: captured_at?,
        grip: Some(integer("grip", grip)?),
        intent: Some(check_intent(intent, context.n_joints)?),
    })
}

fn check_intent(intent: IntentMessage, n_joints: usize) -> Result<SteeringIntent, MessageError> {
    Ok(match intent {
        IntentMessage::Hand { base_from_hand } => SteeringIntent::Hand {
            base_from_hand: pose("base_from_hand", base_from_hand)?,
        },
        IntentMessage::Pose { base_from_tip } => SteeringIntent::Pose {
            base_from_tip: pose("base_from_tip", base_from_tip)?,
        },
        IntentMessage::Joints { position } => SteeringIntent::Joints {
            position: joints("position", position, n_joints)?,
        },
        IntentMessage::JointVelocity { velocity } => SteeringIntent::JointVelocity {
            velocity: joints("velocity", velocity, n_joints)?,
        },
        IntentMessage::TipVelocity {
            linear_m_s,
            angular_rad_s,
        } => {
            check_numbers("linear_m_s", &linear_m_s)?;
            check_numbers("angular_rad_s", &angular_rad_s)?;
            SteeringIntent::TipVelocity {
                linear_m_s,
                angular_rad_s,
            }
        }
        IntentMessage::BaseVelocity {
            forward_m_s,
            left_m_s,
            yaw_rad_s,
        } => {
            check_numbers("the velocity", &[forward_m_s, left_m_s, yaw_rad_s])?;
            SteeringIntent::BaseVelocity {
                forward_m_s,
                left_m_s,
                yaw_rad_s,
            }
        }
        IntentMessage::BaseGoal {
            x_m,
            y_m,
            heading_rad,
        } => {
            check_numbers("the goal", &[x_m, y_m, heading_rad])?;
            SteeringIntent::BaseGoal {
                x_m,
                y_m,
                heading_rad,
            }
        }
    })
}

fn preview(message: PreviewMessage, n_joints: usize) -> Result<PreviewRequest, MessageError> {
    let goal = match (message.base_from_tip, message.position) {
        (Some(base_from_tip), None) => PreviewGoal::Pose {
            base_from_tip: pose("base_from_tip", base_from_tip)?,
        },
        (None, Some(position)) => PreviewGoal::Joints {
            position: joints("position", position, n_joints)?,
        },
        _ => return Err(MessageError::PreviewGoal),
    };
    let id = integer("id", message.id)?;
    Ok(PreviewRequest { id, goal })
}

/// The time of a command on the clock of this process.
fn captured_at(
    captured_micros: f64,
    received_at: Instant,
    clock: ServerClock,
) -> Result<Instant, MessageError> {
    let difference_secs = captured_micros * 1e-6 - clock.millis(received_at) * 1e-3;
    // The comparison is written so that NaN fails.
    let is_near = difference_secs.abs() <= MAX_CLOCK_DIFFERENCE_SECS;
    let error = MessageError::Clock { difference_secs };
    let difference = Duration::try_from_secs_f64(difference_secs.abs());
    let (true, Ok(difference)) = (is_near, difference) else {
        return Err(error);
    };
    let at = if difference_secs < 0.0 {
        received_at.checked_sub(difference)
    } else {
        received_at.checked_add(difference)
    };
    at.ok_or(error)
}

fn integer(name: &'static str, got: u64) -> Result<u64, MessageError> {
    if got > MAX_INTEGER {
        return Err(MessageError::LargeInteger { name, got });
    }
    Ok(got)
}

fn joints(name: &'static str, values: Vec<f64>, n_joints: usize) -> Result<Vec<f64>, MessageError> {
    if values.len() != n_joints {
        return Err(MessageError::JointCount {
            name,
            got: values.len(),
            expected: n_joints,
        });
    }
    check_numbers(name, &values)?;
    Ok(values)
}

fn pose(name: &'static str, numbers: [f64; 7]) -> Result<[f64; 7], MessageError> {
    check_numbers(name, &numbers)?;
    let got = numbers[3..]
        .iter()
        .map(|number| number * number)
        .sum::<f64>()
        .sqrt();
    if (got - 1.0).abs() > MAX_ROUNDING {
        return Err(MessageError::Quaternion { name, got });
    }
    Ok(numbers)
}

fn check_numbers(name: &'static str, numbers: &[f64]) -> Result<(), MessageError> {
    let is_large = |number: &&f64| number.is_nan() || number.abs() > MAX_NUMBER;
    match numbers.iter().find(is_large) {
        Some(&got) => Err(MessageError::LargeNumber { name, got }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests;
