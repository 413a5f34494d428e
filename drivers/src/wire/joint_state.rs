//! Joint states as JSON with a schema of fieldrig. Foxglove has no schema for joint states that
//! every version of its viewer opens.

use super::Malformed;
use kinematics::{JointState, Stamp};
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Name of the schema.
pub const SCHEMA_NAME: &str = "fieldrig.JointState";

/// The JSON schema of the messages.
pub const SCHEMA: &str = r#"{
  "$schema": "https://json-schema.org/draft/2020-12/schema",
  "title": "fieldrig.JointState",
  "description": "Readings of the joints of one arm at one instant, in the order of the joint names in the channel's metadata",
  "type": "object",
  "properties": {
    "timestamp": {
      "type": "object",
      "properties": { "sec": { "type": "integer" }, "nsec": { "type": "integer" } }
    },
    "position": { "type": "array", "items": { "type": "number" }, "description": "radians or meters; null: not a number" },
    "velocity": { "type": "array", "items": { "type": "number" }, "description": "radians or meters per second; empty: not reported" },
    "effort": { "type": "array", "items": { "type": "number" }, "description": "newton meters or newtons; empty: not reported" }
  }
}"#;

#[derive(Serialize, Deserialize)]
struct Wire {
    timestamp: Timestamp,
    position: Vec<Option<f64>>,
    velocity: Vec<Option<f64>>,
    effort: Vec<Option<f64>>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Timestamp {
    sec: i64,
    nsec: u32,
}

const NANOS_PER_SEC: i64 = 1_000_000_000;
/// The fields of [`Wire`].
const FIELDS: [&str; 4] = ["timestamp", "position", "velocity", "effort"];

/// Encodes joint states as JSON. Decoding restores finite numbers bit for bit. Other numbers become
/// NaN.
pub fn encode(state: &JointState) -> Vec<u8> {
    let nsec = u32::try_from(state.stamp.0.rem_euclid(NANOS_PER_SEC))
        .expect("the remainder is below one billion");
    let wire = Wire {
        timestamp: Timestamp {
            sec: state.stamp.0.div_euclid(NANOS_PER_SEC),
            nsec,
        },
        position: finite(&state.position),
        velocity: finite(&state.velocity),
        effort: finite(&state.effort),
    };
    serde_json::to_vec(&wire).expect("numbers and lists always serialize")
}

/// The numbers. Numbers that are not finite become `None`, because JSON cannot express them.
fn finite(numbers: &[f64]) -> Vec<Option<f64>> {
    numbers
        .iter()
        .map(|number| number.is_finite().then_some(*number))
        .collect()
}

/// Decodes the joint state that [`encode`] encoded.
pub fn decode(bytes: &[u8]) -> Result<JointState, Malformed> {
    let wire: Wire = serde_json::from_slice(bytes).map_err(|e| Malformed::Json {
        reason: e.to_string(),
    })?;
    let Timestamp { sec, nsec } = wire.timestamp;
    // The arithmetic is checked, because the numbers come from a file.
    let nanos = Some(i64::from(nsec)).filter(|nanos| *nanos < NANOS_PER_SEC);
    let stamp = sec
        .checked_mul(NANOS_PER_SEC)
        .zip(nanos)
        .and_then(|(whole, nanos)| whole.checked_add(nanos));
    Ok(JointState {
        stamp: stamp.map(Stamp).ok_or_else(|| Malformed::Json {
            reason: "the timestamp is out of range".into(),
        })?,
        position: numbers(wire.position),
        velocity: numbers(wire.velocity),
        effort: numbers(wire.effort),
    })
}

/// The numbers, with NaN for null.
fn numbers(read: Vec<Option<f64>>) -> Vec<f64> {
    read.into_iter()
        .map(|number| number.unwrap_or(f64::NAN))
        .collect()
}

/// Names of the fields of a message that [`decode`] does not read, in alphabetical order.
pub fn unknown_fields(bytes: &[u8]) -> Vec<String> {
    let fields: BTreeMap<String, IgnoredAny> = serde_json::from_slice(bytes).unwrap_or_default();
    fields
        .into_keys()
        .filter(|name| !FIELDS.contains(&name.as_str()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::random::Random;

    #[test]
    fn joint_states_round_trip_exactly() {
        let mut random = Random::new(1);
        for stamp in [0, -1, 1_700_000_000_123_456_789, i64::MAX] {
            let position = (0..7).map(|_| random.uniform(-1.5, 1.5)).collect();
            let sent = JointState {
                stamp: Stamp(stamp),
                velocity: vec![-0.0, f64::MIN_POSITIVE],
                position,
                effort: vec![],
            };
            let read = decode(&encode(&sent)).expect("own bytes");
            assert_eq!(read, sent);
            assert!(read.velocity[0].is_sign_negative());
        }
    }

    #[test]
    fn nan_round_trips() {
        let sent = JointState {
            stamp: Stamp(1),
            position: vec![f64::NAN, 1.0],
            velocity: vec![],
            effort: vec![],
        };
        let read = decode(&encode(&sent)).expect("own bytes");
        assert!(read.position[0].is_nan() && read.position[1] == 1.0);
    }

    #[test]
    fn unknown_fields_are_named() {
        let sent = JointState {
            stamp: Stamp(1),
            position: vec![1.0],
            velocity: vec![],
            effort: vec![],
        };
        let text = String::from_utf8(encode(&sent)).expect("text");
        assert_eq!(unknown_fields(text.as_bytes()), [""; 0]);
        let more = text.replacen('{', r#"{"names":["a"],"frame_id":"arm","#, 1);
        assert_eq!(decode(more.as_bytes()), Ok(sent));
        assert_eq!(unknown_fields(more.as_bytes()), ["frame_id", "names"]);
        assert!(decode(text.replace("nsec", "nanosec").as_bytes()).is_err());
        let error = decode(
            text.replace(r#""nsec":1"#, r#""nsec":1000000000"#)
                .as_bytes(),
        )
        .expect_err("too large");
        assert_eq!(error.to_string(), "the timestamp is out of range");
    }

    #[test]
    fn broken_json_is_error_and_schema_is_valid() {
        assert!(decode(b"{\"timestamp\":").is_err());
        assert!(
            decode(b"{}")
                .expect_err("empty")
                .to_string()
                .contains("timestamp")
        );
        serde_json::from_str::<serde_json::Value>(SCHEMA).expect("valid JSON");
    }
}
