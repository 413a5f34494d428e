//! Messages to clients of `/steer`, as in `docs/reference/protocol.md`.

use crate::clock::ServerClock;
use crate::steering::arm_description::ArmDescription;
use crate::steering::preview::Preview;
use crate::steering::request::RefusedRequest;
use crate::steering::state::{AppliedLimit, SteeredBaseState, SteeredPart, SteeringState};
use crate::topics::operator_status::ConnectedClient;
use axum::extract::ws::Message;
use serde::Serialize;

/// JSON text messages.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum SteeringMessage<'a> {
    /// First message of a connection.
    Arm {
        client: u64,
        may_steer: bool,
        #[serde(flatten)]
        description: &'a ArmDescription,
    },
    /// State of the arm.
    State(Box<StateMessage<'a>>),
    /// Why a request was refused.
    Refused {
        request: RefusedRequest,
        text: &'a str,
    },
    /// Whether a goal can be reached.
    Preview {
        id: u64,
        #[serde(flatten)]
        preview: &'a Preview,
    },
    /// Reply to a ping.
    Pong { id: u64, time_micros: f64 },
}

/// Fields of `state`.
#[derive(Debug, Serialize)]
pub(crate) struct StateMessage<'a> {
    time_micros: f64,
    holder: Option<u64>,
    lease_left_secs: Option<f64>,
    offered_to: Option<u64>,
    stop: Option<&'a str>,
    stop_number: Option<u64>,
    is_recovering: bool,
    is_moving: bool,
    moved_part: Option<SteeredPart>,
    position: &'a [f64],
    target: Option<&'a [f64]>,
    base_from_tip: [f64; 7],
    base_from_target: Option<[f64; 7]>,
    limits: &'a [AppliedLimit],
    applied: Option<AppliedMessage>,
    contacts: Option<u64>,
    base: Option<&'a SteeredBaseState>,
    clients: &'a [ConnectedClient],
}

/// The command that became a setpoint.
#[derive(Debug, Serialize)]
struct AppliedMessage {
    device: u64,
    sequence: u64,
    captured_micros: f64,
    applied_micros: f64,
}

impl<'a> SteeringMessage<'a> {
    /// The message about a state.
    pub(crate) fn state(
        state: &'a SteeringState,
        clients: &'a [ConnectedClient],
        clock: ServerClock,
    ) -> Self {
        Self::State(Box::new(StateMessage {
            time_micros: micros(clock.millis(state.at)),
            holder: state.holder,
            lease_left_secs: state.lease_left_secs,
            offered_to: state.offered_to,
            stop: state.stop.as_deref(),
            stop_number: state.stop_number,
            is_recovering: state.is_recovering,
            is_moving: state.is_moving,
            moved_part: state.moved_part,
            position: &state.position,
            target: state.target.as_deref(),
            base_from_tip: state.base_from_tip,
            base_from_target: state.base_from_target,
            limits: &state.limits,
            applied: state.applied.map(|applied| AppliedMessage {
                device: applied.device,
                sequence: applied.sequence,
                captured_micros: micros(clock.millis(applied.captured_at)),
                applied_micros: micros(clock.millis(applied.applied_at)),
            }),
            contacts: state.contacts,
            base: state.base.as_ref(),
            clients,
        }))
    }

    /// The reply to a ping, sent now.
    pub(crate) fn pong(id: u64, clock: ServerClock) -> Self {
        let time_micros = micros(clock.now_millis());
        Self::Pong { id, time_micros }
    }

    /// The message.
    pub(crate) fn to_message(&self) -> Message {
        let json = serde_json::to_string(self)
            .expect("these types hold only strings, numbers and maps with string keys");
        Message::text(json)
    }
}

fn micros(millis: f64) -> f64 {
    millis * 1e3
}
