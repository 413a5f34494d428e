use super::{ClientRequest, MAX_INTEGER, MessageContext, Refusal, read_message};
use crate::clock::ServerClock;
use crate::server::access::Role;
use crate::steering::request::{
    PreviewGoal, RefusedRequest, SteeringCommand, SteeringIntent, SteeringRequest,
};
use serde_json::{Value, json};
use std::time::{Duration, Instant};

const N_JOINTS: usize = 2;

/// A server that has been running for a minute.
struct Desk {
    clock: ServerClock,
    now: Instant,
}

impl Desk {
    fn new() -> Self {
        let clock = ServerClock::start();
        let now = clock.instant(60_000.0).expect("in a minute");
        Self { clock, now }
    }

    fn read_as(&self, role: Role, text: &str) -> Result<ClientRequest, Refusal> {
        let context = MessageContext {
            role,
            clock: self.clock,
            n_joints: N_JOINTS,
        };
        read_message(text, self.now, context)
    }

    fn read(&self, message: &Value) -> Result<ClientRequest, Refusal> {
        self.read_as(Role::Operator, &message.to_string())
    }

    fn command(&self, message: &Value) -> SteeringCommand {
        match self.read(message) {
            Ok(ClientRequest::Steering(SteeringRequest::Command(command))) => command,
            other => panic!("{message} was read as {other:?}"),
        }
    }

    fn refusal(&self, text: &str) -> Refusal {
        match self.read_as(Role::Operator, text) {
            Err(refusal) => refusal,
            Ok(request) => panic!("{text} was accepted as {request:?}"),
        }
    }
}

fn command_message() -> Value {
    json!({
        "type": "command", "device": 3, "sequence": 17, "captured_micros": 59_980_000.0, "grip": 2,
        "intent": {"kind": "pose", "base_from_tip": [0.4, 0, 0.5, 0, 0, 0, 1]},
    })
}

fn changed(field: &str, value: Value) -> Value {
    let mut message = command_message();
    message[field] = value;
    message
}

#[test]
fn commands_are_read_with_their_times_and_intents() {
    let desk = Desk::new();
    let command = desk.command(&command_message());
    let expected = SteeringCommand {
        device: 3,
        sequence: 17,
        captured_at: command.captured_at,
        grip: Some(2),
        intent: Some(SteeringIntent::Pose {
            base_from_tip: [0.4, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0],
        }),
    };
    assert_eq!(command, expected);
    let age = desk.now - command.captured_at;
    assert!(age.abs_diff(Duration::from_millis(20)) < Duration::from_micros(1));

    let intents = [
        (
            json!({"kind": "hand", "base_from_hand": [1, 2, 3, 0, 0, 1, 0]}),
            SteeringIntent::Hand {
                base_from_hand: [1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0],
            },
        ),
        (
            json!({"kind": "joints", "position": [0.5, -1]}),
            SteeringIntent::Joints {
                position: vec![0.5, -1.0],
            },
        ),
        (
            json!({"kind": "joint_velocity", "velocity": [0, 0.25]}),
            SteeringIntent::JointVelocity {
                velocity: vec![0.0, 0.25],
            },
        ),
        (
            json!({"kind": "tip_velocity", "linear_m_s": [0.1, 0, 0], "angular_rad_s": [0, 0, 1]}),
            SteeringIntent::TipVelocity {
                linear_m_s: [0.1, 0.0, 0.0],
                angular_rad_s: [0.0, 0.0, 1.0],
            },
        ),
    ];
    for (message, intent) in intents {
        let command = desk.command(&changed("intent", message));
        assert_eq!(command.intent, Some(intent));
    }
}

#[test]
fn leases_previews_and_pings_are_read() {
    let desk = Desk::new();
    let lease = |message: Value| match desk.read(&message) {
        Ok(ClientRequest::Steering(request)) => request,
        other => panic!("{message} was read as {other:?}"),
    };
    let cases = [
        ("take", SteeringRequest::TakeLease),
        ("renew", SteeringRequest::RenewLease),
        ("release", SteeringRequest::ReleaseLease),
        ("offer", SteeringRequest::OfferLease { to: 12 }),
    ];
    for (action, expected) in cases {
        let message = json!({"type": "lease", "action": action, "to": 12});
        assert_eq!(lease(message), expected);
    }
    let rearm = lease(json!({"type": "rearm", "stop": 3}));
    assert_eq!(rearm, SteeringRequest::Rearm { stop: 3 });
    for stop in [Value::Null, json!(-1), json!("3"), json!(1_u64 << 53)] {
        let message = json!({"type": "rearm", "stop": stop});
        let refusal = desk.read(&message).expect_err("no number of a stop");
        assert_eq!(refusal.request, RefusedRequest::Rearm);
        assert!(refusal.text.contains("stop") || refusal.text.contains("valid"));
    }
    let eye = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0];
    assert_eq!(
        lease(json!({"type": "view", "world_from_camera": eye})),
        SteeringRequest::View {
            world_from_camera: eye
        }
    );
    let SteeringRequest::Preview(preview) =
        lease(json!({"type": "preview", "id": 8, "position": [0, 1]}))
    else {
        panic!("no preview");
    };
    let position = vec![0.0, 1.0];
    assert_eq!(preview.goal, PreviewGoal::Joints { position });
    assert_eq!(
        desk.read(&json!({"type": "ping", "id": 5})),
        Ok(ClientRequest::Ping { id: 5 })
    );
}

#[test]
fn unknown_fields_are_ignored() {
    let desk = Desk::new();
    let mut message = command_message();
    message["pressure"] = json!({"newton": [1, 2]});
    message["intent"]["hand"] = json!("left");
    assert_eq!(desk.command(&message), desk.command(&command_message()));
    let stop = json!({"type": "stop", "because": "of a reason", "in": {"a": 1}});
    assert_eq!(
        desk.read(&stop),
        Ok(ClientRequest::Steering(SteeringRequest::Stop))
    );
}

#[test]
fn nothing_else_in_a_message_keeps_a_stop_from_being_obeyed() {
    let desk = Desk::new();
    for text in [
        r#"{"type":"stop","at":1e999}"#,
        r#"{"at":-1e999,"type":"stop"}"#,
        r#"{"type":"stop","sequence":-5,"sequence":99999999999999999999999}"#,
    ] {
        let read = desk.read_as(Role::Viewer, text);
        assert_eq!(
            read,
            Ok(ClientRequest::Steering(SteeringRequest::Stop)),
            "{text}"
        );
    }
}

#[test]
fn wrong_values_are_refused_with_one_sentence() {
    let desk = Desk::new();
    let pose = |numbers: Value| json!({"kind": "pose", "base_from_tip": numbers});
    let joints = |numbers: Value| json!({"kind": "joints", "position": numbers});
    let velocity = |numbers: Value| json!({"kind": "tip_velocity", "linear_m_s": numbers, "angular_rad_s": [0, 0, 0]});
    let cases = [
        (changed("sequence", json!(MAX_INTEGER + 1)), "sequence is"),
        (changed("sequence", json!(u64::MAX)), "sequence is"),
        (changed("sequence", json!(-1)), "-1"),
        (changed("sequence", json!(1.5)), "1.5"),
        (changed("sequence", json!(1e30)), "floating point"),
        (changed("device", json!(u64::MAX)), "device is"),
        (changed("device", json!("left")), "string"),
        (changed("grip", json!(u64::MAX)), "grip is"),
        (changed("grip", json!(true)), "boolean"),
        (
            changed("captured_micros", json!(80e6)),
            "server's clock by 20.0 s",
        ),
        (
            changed("captured_micros", json!(-1e6)),
            "server's clock by -61.0 s",
        ),
        (changed("captured_micros", json!(1.7e15)), "server's clock"),
        (changed("captured_micros", json!(-1e300)), "server's clock"),
        (changed("captured_micros", Value::Null), "null"),
        (changed("intent", Value::Null), "needs an intent"),
        (changed("intent", json!({"kind": "jump"})), "jump"),
        (changed("intent", json!({"kind": "ju\nmp\r"})), "ju mp "),
        (changed("intent", pose(json!([0, 0, 0, 0, 0, 1]))), "length"),
        (
            changed("intent", pose(json!([0, 0, 0, 0, 0, 0, 1, 0]))),
            "length",
        ),
        (
            changed("intent", pose(json!([0, 0, 0, 0, 0, 0, 0]))),
            "the length 0.000",
        ),
        (
            changed("intent", pose(json!([0, 0, 0, 1, 0, 0, 1]))),
            "the length 1.414",
        ),
        (
            changed("intent", pose(json!([1e7, 0, 0, 0, 0, 0, 1]))),
            "contains 10000000",
        ),
        (
            changed("intent", pose(json!([null, 0, 0, 0, 0, 0, 1]))),
            "null",
        ),
        (
            changed("intent", joints(json!([0.0]))),
            "position has 1 values",
        ),
        (
            changed("intent", joints(json!([0, 0, 0]))),
            "position has 3 values",
        ),
        (
            changed("intent", joints(json!([0, 1e300]))),
            "position contains",
        ),
        (
            changed("intent", velocity(json!([0, 0, -1e300]))),
            "linear_m_s contains",
        ),
        (changed("intent", velocity(json!([0, 0]))), "length"),
    ];
    for (message, named) in cases {
        let refusal = desk.refusal(&message.to_string());
        assert_eq!(refusal.request, RefusedRequest::Command, "{message}");
        assert!(
            refusal.text.contains(named) && !refusal.text.contains('\n'),
            "{message}: {}",
            refusal.text
        );
    }
    // Numbers beyond the range of floats cannot be in a `Value`.
    let text = command_message().to_string().replace("0.4", "1e999");
    assert!(desk.refusal(&text).text.contains("number out of range"));
}

#[test]
fn messages_of_no_known_type_are_refused() {
    let desk = Desk::new();
    for (text, named) in [
        (r#"{"type":"launch"}"#, "unknown type \"launch\""),
        (r#"{"type":7}"#, "no type"),
        ("{}", "no type"),
        ("", "no type"),
        ("[1,2]", "no type"),
        ("{\"type\":\"stop\"", "no type"),
    ] {
        let refusal = desk.refusal(text);
        assert_eq!(refusal.request, RefusedRequest::Message, "{text}");
        assert!(refusal.text.contains(named), "{text}: {}", refusal.text);
    }
    let long = json!({"type": "x".repeat(4000)}).to_string();
    assert!(desk.refusal(&long).text.chars().count() <= 300);
    for (message, kind) in [
        (json!({"type": "lease"}), RefusedRequest::Lease),
        (
            json!({"type": "lease", "action": "steal"}),
            RefusedRequest::Lease,
        ),
        (
            json!({"type": "lease", "action": "offer"}),
            RefusedRequest::Lease,
        ),
        (json!({"type": "preview", "id": 1}), RefusedRequest::Preview),
        (
            json!({"type": "preview", "id": 1, "position": [0, 0], "base_from_tip": [0, 0, 0, 0, 0, 0, 1]}),
            RefusedRequest::Preview,
        ),
        (
            json!({"type": "preview", "id": 1, "position": [0]}),
            RefusedRequest::Preview,
        ),
        (json!({"type": "ping"}), RefusedRequest::Message),
    ] {
        assert_eq!(
            desk.refusal(&message.to_string()).request,
            kind,
            "{message}"
        );
    }
}

#[test]
fn an_open_switch_is_obeyed_even_if_the_rest_is_wrong() {
    let desk = Desk::new();
    let wrong = [
        ("captured_micros", json!(1e15)),
        ("sequence", json!(u64::MAX)),
        ("intent", json!({"kind": "joints", "position": [1, 2, 3]})),
        ("intent", Value::Null),
    ];
    for (field, value) in wrong {
        let mut message = changed(field, value);
        message["grip"] = Value::Null;
        assert_eq!(desk.command(&message).grip, None, "{message}");
        message.as_object_mut().expect("an object").remove("grip");
        assert_eq!(desk.command(&message).grip, None, "{message}");
    }
}

#[test]
fn viewers_can_only_stop_and_ping() {
    let desk = Desk::new();
    let refused = [
        json!({"type": "lease", "action": "take"}),
        json!({"type": "lease", "action": "release"}),
        json!({"type": "rearm", "stop": 1}),
        json!({"type": "preview", "id": 1, "position": [0, 0]}),
        json!({"type": "view", "world_from_camera": [0, 0, 0, 0, 0, 0, 1]}),
        command_message(),
        changed("grip", Value::Null),
    ];
    for message in refused {
        let read = desk.read_as(Role::Viewer, &message.to_string());
        let refusal = read.expect_err("a viewer may not send this");
        assert!(refusal.text.contains("role operator"), "{}", refusal.text);
    }
    for message in [json!({"type": "stop"}), json!({"type": "ping", "id": 1})] {
        let read = desk.read_as(Role::Viewer, &message.to_string());
        assert!(read.is_ok(), "{read:?}");
    }
}
