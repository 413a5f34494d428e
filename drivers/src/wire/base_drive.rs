//! UDP datagrams that drive a base, and its replies. Each datagram is one JSON object.
//! `docs/reference/udp.md` documents the fields.

use super::{Malformed, json};
use crate::base_motion::BaseVelocity;
use serde::{Deserialize, Serialize};

/// Version of the format.
pub const VERSION: u32 = 1;
/// Greatest integer that every JSON parser represents exactly.
pub const MAX_INTEGER: u64 = (1 << 53) - 1;
/// Largest absolute velocity, m/s or rad/s. Larger numbers are errors of the sender.
const MAX_VELOCITY: f64 = 100.0;
/// Maximum number of characters of a text of the base.
const MAX_TEXT_CHARS: usize = 200;

const COMMAND: &str = "drive";
const REPLY: &str = "drive_state";

/// A velocity for a base.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DriveCommand {
    /// Number that identifies the sending program, new with each start.
    pub session: u64,
    /// Number of the command, which increases.
    pub seq: u64,
    /// The velocity.
    pub velocity: BaseVelocity,
    /// When the base must stop if no newer command has arrived, on the clock of the base's replies.
    /// `None` only for a velocity of zero, which needs no end.
    pub expires_nanos: Option<i64>,
}

/// The reply of a base to a command.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveReply {
    /// Session of the command.
    pub session: u64,
    /// Number of the command.
    pub seq: u64,
    /// Current time on a clock of the base that runs at a constant rate, nanoseconds.
    pub stamp_nanos: i64,
    /// Measured velocity.
    pub velocity: BaseVelocity,
    /// Why the base cannot move; `None` if it can.
    pub fault: Option<String>,
    /// Why the base refuses the command; `None` if it accepts it.
    pub refusal: Option<String>,
}

#[derive(Serialize, Deserialize)]
struct Wire {
    kind: String,
    version: u32,
    session: u64,
    seq: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    stamp_nanos: Option<i64>,
    #[serde(default)]
    forward_m_s: Option<f64>,
    #[serde(default)]
    left_m_s: Option<f64>,
    #[serde(default)]
    yaw_rad_s: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    expires_nanos: Option<i64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fault: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    refusal: Option<String>,
}

/// Writes a command.
#[must_use]
pub fn encode_command(command: &DriveCommand) -> Vec<u8> {
    encode(&Wire {
        expires_nanos: command.expires_nanos,
        ..wire(COMMAND, command.session, command.seq, &command.velocity)
    })
}

/// Reads a command, as a base does.
///
/// # Errors
/// If it is not valid.
pub fn decode_command(bytes: &[u8]) -> Result<DriveCommand, Malformed> {
    let wire = decode(bytes, COMMAND)?;
    let velocity = velocity(&wire)?;
    if velocity != BaseVelocity::ZERO && wire.expires_nanos.is_none() {
        return Err(Malformed::Missing {
            name: "expires_nanos of a velocity that is not zero",
        });
    }
    Ok(DriveCommand {
        session: wire.session,
        seq: wire.seq,
        velocity,
        expires_nanos: wire.expires_nanos,
    })
}

/// Writes a reply, as a base does.
#[must_use]
pub fn encode_reply(reply: &DriveReply) -> Vec<u8> {
    encode(&Wire {
        stamp_nanos: Some(reply.stamp_nanos),
        fault: reply.fault.clone(),
        refusal: reply.refusal.clone(),
        ..wire(REPLY, reply.session, reply.seq, &reply.velocity)
    })
}

/// Reads a reply.
///
/// # Errors
/// If it is not valid.
pub fn decode_reply(bytes: &[u8]) -> Result<DriveReply, Malformed> {
    let wire = decode(bytes, REPLY)?;
    let velocity = velocity(&wire)?;
    let stamp_nanos = wire.stamp_nanos.ok_or(Malformed::Missing {
        name: "stamp_nanos",
    })?;
    Ok(DriveReply {
        session: wire.session,
        seq: wire.seq,
        stamp_nanos,
        velocity,
        fault: wire.fault.as_deref().map(sentence),
        refusal: wire.refusal.as_deref().map(sentence),
    })
}

fn wire(kind: &str, session: u64, seq: u64, velocity: &BaseVelocity) -> Wire {
    Wire {
        kind: kind.to_owned(),
        version: VERSION,
        session,
        seq,
        stamp_nanos: None,
        forward_m_s: Some(velocity.forward_m_s),
        left_m_s: Some(velocity.left_m_s),
        yaw_rad_s: Some(velocity.yaw_rad_s),
        expires_nanos: None,
        fault: None,
        refusal: None,
    }
}

fn encode(wire: &Wire) -> Vec<u8> {
    serde_json::to_vec(wire).expect("the type holds only strings and numbers")
}

fn decode(bytes: &[u8], kind: &str) -> Result<Wire, Malformed> {
    let unsupported = |name, found: String, expected: &str| Malformed::Unsupported {
        name,
        found,
        expected: expected.to_owned(),
    };
    let text = std::str::from_utf8(bytes)
        .map_err(|_| unsupported("the datagram", "not UTF-8".to_owned(), "JSON text"))?;
    let wire: Wire = serde_json::from_str(&json::nan_as_null(text)).map_err(|error| {
        let found = sentence(&error.to_string());
        unsupported(
            "the datagram",
            found,
            "a JSON object, see docs/reference/udp.md",
        )
    })?;
    if wire.kind != kind {
        let found = sentence(&wire.kind);
        return Err(unsupported("kind", found, kind));
    }
    if wire.version != VERSION {
        let found = wire.version.to_string();
        return Err(unsupported("version", found, "1"));
    }
    for (name, value) in [("session", wire.session), ("seq", wire.seq)] {
        if value > MAX_INTEGER {
            return Err(unsupported(name, value.to_string(), "at most 2^53 - 1"));
        }
    }
    Ok(wire)
}

fn velocity(wire: &Wire) -> Result<BaseVelocity, Malformed> {
    let number = |name: &'static str, value: Option<f64>| {
        let value = value.ok_or(Malformed::Missing { name })?;
        // Written so that NaN is refused.
        let is_possible = value.abs() <= MAX_VELOCITY;
        if is_possible {
            return Ok(value);
        }
        Err(Malformed::Unsupported {
            name,
            found: value.to_string(),
            expected: format!("at most {MAX_VELOCITY}"),
        })
    };
    Ok(BaseVelocity {
        forward_m_s: number("forward_m_s", wire.forward_m_s)?,
        left_m_s: number("left_m_s", wire.left_m_s)?,
        yaw_rad_s: number("yaw_rad_s", wire.yaw_rad_s)?,
    })
}

/// A text of another program as one line of limited length.
fn sentence(text: &str) -> String {
    let printable = text.chars().map(|c| if c.is_control() { ' ' } else { c });
    printable.take(MAX_TEXT_CHARS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const VELOCITY: BaseVelocity = BaseVelocity {
        forward_m_s: 0.25,
        left_m_s: -0.125,
        yaw_rad_s: 0.5,
    };

    #[test]
    fn commands_and_replies_survive_their_text() {
        let command = DriveCommand {
            session: MAX_INTEGER,
            seq: 7,
            velocity: VELOCITY,
            expires_nanos: Some(81_234_567_890_123),
        };
        assert_eq!(decode_command(&encode_command(&command)), Ok(command));
        let stop = DriveCommand {
            velocity: BaseVelocity::ZERO,
            expires_nanos: None,
            ..command
        };
        assert_eq!(decode_command(&encode_command(&stop)), Ok(stop));
        let reply = DriveReply {
            session: 3,
            seq: 7,
            stamp_nanos: 81_234_500_000_000,
            velocity: VELOCITY,
            fault: Some("emergency stop".to_owned()),
            refusal: None,
        };
        assert_eq!(decode_reply(&encode_reply(&reply)), Ok(reply));
    }

    #[test]
    fn documented_datagrams_are_decoded() {
        let page = include_str!("../../../docs/reference/udp.md");
        let examples = |kind: &str| {
            let start = format!(r#"{{"kind":"{kind}","#);
            page.lines().find(|line| line.starts_with(&start))
        };
        let command = examples(COMMAND).expect("an example");
        let command = decode_command(command.as_bytes()).expect("a valid command");
        assert_eq!(command.velocity.to_array(), [0.25, 0.0, -0.1]);
        let reply = examples(REPLY).expect("an example");
        let reply = decode_reply(reply.as_bytes()).expect("a valid reply");
        assert_eq!((reply.session, reply.seq), (command.session, command.seq));
        let left_nanos = command.expires_nanos.map(|end| end - reply.stamp_nanos);
        assert_eq!(left_nanos, Some(100_000_000), "as long as velocities last");
    }

    #[test]
    fn invalid_datagrams_are_refused_with_the_name_of_the_field() {
        let good = r#"{"kind":"drive_state","version":1,"session":3,"seq":7,"stamp_nanos":5,"forward_m_s":0,"left_m_s":0,"yaw_rad_s":0}"#;
        assert!(decode_reply(good.as_bytes()).is_ok());
        for (from, to, expected) in [
            ("drive_state", "drive", "kind"),
            ("\"version\":1", "\"version\":2", "version"),
            ("\"seq\":7", "\"seq\":9007199254740992", "seq"),
            ("\"left_m_s\":0", "\"left_m_s\":NaN", "left_m_s"),
            ("\"yaw_rad_s\":0", "\"yaw_rad_s\":1e9", "yaw_rad_s"),
            ("\"stamp_nanos\":5,", "", "stamp_nanos"),
            ("{", "[", "JSON object"),
        ] {
            let error = decode_reply(good.replace(from, to).as_bytes()).expect_err(to);
            assert!(error.to_string().contains(expected), "{error}");
        }
        // A velocity without an end would move the base until the next command.
        let endless = r#"{"kind":"drive","version":1,"session":3,"seq":7,"forward_m_s":0.1,"left_m_s":0,"yaw_rad_s":0}"#;
        let error = decode_command(endless.as_bytes()).expect_err("no expiry");
        assert!(error.to_string().contains("expires_nanos"), "{error}");
        for cut in 0..good.len() {
            let _ = decode_reply(&good.as_bytes()[..cut]);
        }
    }
}
