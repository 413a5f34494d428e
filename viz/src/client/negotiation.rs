//! Agrees with a client on a protocol version and on capabilities.

use crate::client::protocol::{BASE_PROTOCOL_VERSION, ClientHello, PROTOCOL_VERSION};
use crate::topics::TOPICS;

/// Names of the capabilities of this server, except those of topics.
const CAPABILITIES: [&str; 10] = [
    "views",
    "subscribe",
    "compact_depth",
    KEYFRAME_CHANGES,
    PARTS,
    HEARTBEAT,
    "control",
    "edit",
    "shown",
    "keyframe_images",
];
const KEYFRAME_CHANGES: &str = "keyframe_changes";
const PARTS: &str = "parts";
const HEARTBEAT: &str = "heartbeat";

/// Capabilities that change the messages that the server sends without a request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Negotiated {
    /// The client applies changes of the keyframe list, so the list is not sent in full each time.
    pub(crate) has_keyframe_changes: bool,
    /// The client joins the parts of binary messages.
    pub(crate) has_parts: bool,
    /// The client sends messages all the time, so that silence shows a broken connection.
    pub(crate) has_heartbeat: bool,
}

/// The reply to a client's hello: the version, the capabilities by name, and those that change the
/// server's behavior.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Agreement {
    /// Protocol version of the connection.
    pub(crate) protocol: u32,
    /// Capabilities of both sides.
    pub(crate) names: Vec<&'static str>,
    /// The same capabilities.
    pub(crate) negotiated: Negotiated,
}

/// Names of the capabilities of this server.
pub(crate) fn capabilities() -> impl Iterator<Item = &'static str> {
    let of_topics = TOPICS.iter().filter_map(|entry| entry.capability);
    CAPABILITIES.into_iter().chain(of_topics)
}

/// Agrees on the newest version that both sides support. The error is the reason why there is none,
/// in one sentence.
pub(crate) fn negotiate(hello: &ClientHello) -> Result<Agreement, String> {
    let [oldest, newest] = match (hello.protocols, hello.protocol) {
        (Some([oldest, newest]), _) if oldest <= newest => [oldest, newest],
        (None, Some(only)) => [only, only],
        (Some([oldest, newest]), _) => {
            return Err(format!(
                "protocols is [{oldest}, {newest}], expected the oldest version, then the newest"
            ));
        }
        (None, None) => {
            return Err(
                "hello needs protocol or protocols, the versions that the client supports"
                    .to_owned(),
            );
        }
    };
    // The newest version that both sides may support is the smaller of their newest versions. It
    // must not be below the oldest version of either side.
    let protocol = newest.min(PROTOCOL_VERSION);
    if protocol < oldest.max(BASE_PROTOCOL_VERSION) {
        let client = if oldest == newest {
            oldest.to_string()
        } else {
            format!("{oldest} to {newest}")
        };
        let outdated = if newest < BASE_PROTOCOL_VERSION {
            "update the client"
        } else {
            "update fieldrig"
        };
        return Err(format!(
            "the client supports protocol version {client}, this server {BASE_PROTOCOL_VERSION} to {PROTOCOL_VERSION}: \
             {outdated}"
        ));
    }
    // The names have the order of the server's list, and each name occurs once, whatever the client
    // sends.
    let names: Vec<_> = capabilities()
        .filter(|name| hello.capabilities.iter().any(|wanted| wanted == name))
        .collect();
    let has = |name| names.contains(&name);
    let negotiated = Negotiated {
        has_keyframe_changes: has(KEYFRAME_CHANGES),
        has_parts: has(PARTS),
        has_heartbeat: has(HEARTBEAT),
    };
    Ok(Agreement {
        protocol,
        names,
        negotiated,
    })
}

#[cfg(test)]
mod tests {
    use super::{Negotiated, negotiate};
    use crate::client::protocol::{BASE_PROTOCOL_VERSION, ClientHello, PROTOCOL_VERSION};
    use serde_json::{Value, json};

    fn hello(message: Value) -> ClientHello {
        serde_json::from_value(message).expect("a hello")
    }

    #[test]
    fn newest_common_version_is_used() {
        let future = PROTOCOL_VERSION + 3;
        for (message, expected) in [
            (
                json!({"protocol": BASE_PROTOCOL_VERSION}),
                BASE_PROTOCOL_VERSION,
            ),
            (json!({"protocol": PROTOCOL_VERSION}), PROTOCOL_VERSION),
            (
                json!({"protocols": [1, BASE_PROTOCOL_VERSION]}),
                BASE_PROTOCOL_VERSION,
            ),
            (
                json!({"protocols": [BASE_PROTOCOL_VERSION, future], "new_field": [1]}),
                PROTOCOL_VERSION,
            ),
        ] {
            assert_eq!(
                negotiate(&hello(message.clone())).expect("agreed").protocol,
                expected,
                "{message}"
            );
        }
    }

    #[test]
    fn clients_without_a_common_version_learn_why() {
        let future = PROTOCOL_VERSION + 1;
        for (message, named) in [
            (json!({"protocol": 1}), "update the client"),
            (
                json!({"protocols": [future, future + 4]}),
                "update fieldrig",
            ),
            (json!({"protocols": [4, 3]}), "oldest"),
            (json!({}), "hello needs protocol"),
        ] {
            let reason = negotiate(&hello(message.clone())).expect_err("no common version");
            assert!(reason.contains(named), "{message}: {reason}");
        }
    }

    #[test]
    fn unknown_capabilities_are_ignored() {
        let message =
            json!({"protocols": [3, 9], "capabilities": ["parts", "telepathy", "parts", "views"]});
        let agreement = negotiate(&hello(message)).expect("agreed");
        assert_eq!(agreement.names, ["views", "parts"]);
        assert_eq!(
            agreement.negotiated,
            Negotiated {
                has_parts: true,
                ..Negotiated::default()
            }
        );
    }
}
