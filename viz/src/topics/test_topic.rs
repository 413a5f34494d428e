//! A topic that exists only in tests, as a template. Like every topic of which all clients receive
//! the same text message, it has this file, an entry in `TOPICS`, and a variant of `ServerMessage`.
//!
//! A topic that clients use also has a public function of [`Hub`], an export of its data type in
//! `lib.rs`, a message in `tests/viewer/protocol.rs`, a module of the page, and a description:
//! ARCHITECTURE.md lists the files. `base_path.rs` is the smallest complete example.

use crate::Hub;
use crate::client::server_message::ServerMessage;
use crate::clock::ServerClock;
use crate::topics::shared_topic::{SharedTopic, only_message};
use crate::topics::{DefaultRate, Priority};
use axum::extract::ws::Message;
use std::sync::Arc;
use std::time::Duration;

/// The air temperature at the robot.
#[derive(Default)]
pub(crate) struct Weather;

impl SharedTopic for Weather {
    const NAME: &'static str = "weather";
    const DEFAULT: DefaultRate = DefaultRate::Off;
    const PRIORITY: Priority = Priority::Background;
    // Temperatures change slowly.
    const PERIOD: Duration = Duration::from_millis(50);
    type Source = Option<Celsius>;

    fn encode(&mut self, source: &Self::Source, _: ServerClock) -> Vec<(Arc<str>, Message)> {
        let message =
            source.map(|Celsius(celsius)| ServerMessage::Weather { celsius }.to_message());
        only_message(message)
    }
}

/// A temperature.
#[derive(Clone, Copy)]
pub(crate) struct Celsius(f64);

impl Hub {
    fn set_temperature(&self, celsius: f64) {
        self.latest::<Option<Celsius>>()
            .send_replace(Some(Celsius(celsius)));
    }
}

/// Over a connection, a client receives nothing before the subscription, then the latest value, and
/// then each new value.
#[test]
fn new_topic_reaches_subscribed_clients() {
    let hub = Hub::new();
    let server = crate::Server::start(
        crate::ServerConfig {
            listen: ([127, 0, 0, 1], 0).into(),
        },
        hub.clone(),
    );
    let server = server.expect("a free port");
    let url = format!("ws://{}/ws", server.address());
    let (mut client, _) = tungstenite::connect(url).expect("a server");
    hub.set_temperature(20.5);
    let mut next = |is_wanted: &dyn Fn(&serde_json::Value) -> bool| loop {
        let message = client.read().expect("a message");
        let Ok(text) = message.to_text() else {
            continue;
        };
        let Ok(json) = serde_json::from_str::<serde_json::Value>(text) else {
            continue;
        };
        assert!(json["type"] != "error", "{json}");
        if is_wanted(&json) {
            return json;
        }
        assert!(json["type"] != "weather", "{json}");
        if json["type"] == "hello" {
            let subscribe = r#"{"type":"subscribe","topic":"weather","rate_hz":50}"#;
            client
                .send(tungstenite::Message::text(subscribe))
                .expect("an open connection");
        }
    };
    let temperature = |celsius: f64| {
        move |json: &serde_json::Value| json["type"] == "weather" && json["celsius"] == celsius
    };
    next(&temperature(20.5));
    hub.set_temperature(21.0);
    next(&temperature(21.0));
}
