//! Tests that the JSON schema has the keys and values that the reader of rig files accepts, and
//! that the committed schema is up to date.

use super::tests::{KEYS, RIG, full};
use super::{Rig, rig_file};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::Path;

/// Names of the scene models in the committed schema. The program inserts those of its registry.
const METHODS: [&str; 3] = ["splat", "tsdf", "nerf"];

fn schema() -> Value {
    Rig::json_schema(&METHODS)
}

/// The problems of a value, according to the parts of JSON schema that are used here.
fn problems(schema: &Value, value: &Value, path: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut check = |is_good: bool, rule: &str| {
        if !is_good {
            found.push(format!(
                "{path}: {value} contradicts {rule} of {}",
                schema[rule]
            ));
        }
    };
    let is_of = |kind: &str| match kind {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "integer" => value.as_f64().is_some_and(|number| number.fract() == 0.0),
        "number" => value.is_number(),
        other => panic!("the type {other:?} is not known to this test"),
    };
    check(schema["type"].as_str().is_none_or(is_of), "type");
    if let Some(allowed) = schema["enum"].as_array() {
        check(allowed.contains(value), "enum");
    }
    if let Some(constant) = schema.get("const") {
        check(constant == value, "const");
    }
    if let Some(pattern) = schema["pattern"].as_str() {
        assert_eq!(pattern, ":[0-9]+$", "this test knows no other pattern");
        let port = value.as_str().and_then(|text| text.rsplit_once(':'));
        let is_port = port.is_some_and(|(_, port)| port.parse::<u16>().is_ok());
        check(is_port, "pattern");
    }
    if let Some(number) = value.as_f64() {
        let above = schema["minimum"]
            .as_f64()
            .is_none_or(|limit| number >= limit);
        check(above, "minimum");
        let below = schema["maximum"]
            .as_f64()
            .is_none_or(|limit| number <= limit);
        check(below, "maximum");
    }
    if let Some(items) = value.as_array() {
        let n = items.len() as u64;
        check(
            schema["minItems"].as_u64().is_none_or(|limit| n >= limit),
            "minItems",
        );
        check(
            schema["maxItems"].as_u64().is_none_or(|limit| n <= limit),
            "maxItems",
        );
        let is_unique = (1..items.len()).all(|ix| !items[..ix].contains(&items[ix]));
        check(schema["uniqueItems"] != true || is_unique, "uniqueItems");
        if let Some(schema) = schema.get("items") {
            found.extend(items.iter().flat_map(|item| problems(schema, item, path)));
        }
    }
    if let Some(table) = value.as_object() {
        for key in schema["required"].as_array().into_iter().flatten() {
            let key = key.as_str().expect("a name");
            if !table.contains_key(key) {
                found.push(format!("{path}.{key} is missing"));
            }
        }
        for (key, value) in table {
            let path = format!("{path}.{key}");
            let key_schema = schema["properties"].get(key);
            match (key_schema, &schema["additionalProperties"]) {
                (Some(schema), _) => found.extend(problems(schema, value, &path)),
                (None, Value::Bool(false)) => found.push(format!("{path} is unknown")),
                (None, Value::Null) => {}
                (None, schema) => found.extend(problems(schema, value, &path)),
            }
        }
    }
    if let Some(alternatives) = schema["anyOf"].as_array()
        && !alternatives
            .iter()
            .any(|schema| problems(schema, value, path).is_empty())
    {
        found.push(format!("{path}: {value} matches no alternative"));
    }
    for rule in schema["allOf"].as_array().into_iter().flatten() {
        if problems(&rule["if"], value, path).is_empty() {
            found.extend(problems(&rule["then"], value, path));
        }
    }
    found
}

/// The problems of a rig file.
pub(crate) fn problems_of(text: &str) -> Vec<String> {
    let table: toml::Table = toml::from_str(text).expect("TOML");
    problems(&schema(), &serde_json::to_value(table).expect("JSON"), "")
}

/// The problems of the rig file of the tests with another value.
fn problems_with(key: &str, value: &str) -> Vec<String> {
    let mut rig: toml::Table = toml::from_str(RIG).expect("TOML");
    let value: toml::Table = toml::from_str(&format!("value = {value}")).expect("a TOML value");
    let mut table = &mut rig;
    let (parents, last) = key.rsplit_once('.').expect("a key in a table");
    for parent in parents.split('.') {
        let inner = table
            .entry(parent)
            .or_insert_with(|| toml::Value::Table(toml::Table::new()));
        table = inner.as_table_mut().expect("a table");
    }
    table.insert(last.to_owned(), value["value"].clone());
    problems_of(&toml::to_string(&rig).expect("TOML"))
}

/// Dotted paths of all keys that are not tables. Names that the user chooses are `NAME`.
fn leaves(schema: &Value, path: &str, keys: &mut BTreeSet<String>) {
    // Of the alternatives of the intrinsics, one is a table.
    let tables = schema["anyOf"].as_array().into_iter().flatten();
    let table = tables
        .chain([schema])
        .find(|schema| schema["type"] == "object");
    let Some(table) = table else {
        keys.insert(path.to_owned());
        return;
    };
    let inner = |key: &str| {
        if path.is_empty() {
            key.to_owned()
        } else {
            format!("{path}.{key}")
        }
    };
    for (key, schema) in table["properties"].as_object().into_iter().flatten() {
        leaves(schema, &inner(key), keys);
    }
    if table["additionalProperties"].is_object() {
        leaves(&table["additionalProperties"], &inner("NAME"), keys);
    }
}

#[test]
fn schema_has_exactly_the_keys_that_are_read() {
    let (_, context) = rig_file::keys("rig.toml", &full(), &[], None).expect("TOML");
    let mut keys = BTreeSet::new();
    leaves(&schema(), "", &mut keys);
    let read = context.accessed();
    let missing: Vec<_> = read.difference(&keys).collect();
    assert!(
        missing.is_empty(),
        "read, but not in the schema: {missing:?}"
    );
    let unread: Vec<_> = keys.difference(&read).collect();
    assert!(unread.is_empty(), "in the schema, but not read: {unread:?}");
}

#[test]
fn valid_values_are_accepted() {
    assert_eq!(problems_of(RIG), Vec::<String>::new());
    assert_eq!(problems_of(&full()), Vec::<String>::new());
    for (key, good, _) in KEYS {
        assert_eq!(
            problems_with(key, good),
            Vec::<String>::new(),
            "{key} = {good}"
        );
    }
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs");
    for entry in std::fs::read_dir(folder).expect("the folder rigs") {
        let path = entry.expect("a file").path();
        if path.extension().is_some_and(|ending| ending == "toml") {
            let text = std::fs::read_to_string(&path).expect("text");
            assert_eq!(problems_of(&text), Vec::<String>::new(), "{path:?}");
        }
    }
}

/// Invalid values that a schema cannot detect, because they depend on the robot description, on
/// other keys, or on other files. The reader detects them.
fn is_beyond_a_schema(key: &str) -> bool {
    let needs_urdf = ["arm.urdf", "arm.joints", "arm.base_link", "arm.flange_link"];
    let needs_more = [
        "arm.joint_offsets",
        "arm.sim.true_joint_offsets",
        "arm.motor.first.bus",
        "arm.serial.calibration",
        "camera.wrist.intrinsics",
        "camera.wrist.exposure_micros",
        "camera.wrist.readout_micros",
    ];
    needs_urdf.contains(&key)
        || needs_more.contains(&key)
        || key.ends_with(".quat_xyzw")
        || key.ends_with(".distortion")
        || key.ends_with(".max_m")
        || key.ends_with(".max_elevation_rad")
}

#[test]
fn invalid_values_are_refused() {
    let accepted: Vec<_> = KEYS
        .iter()
        .filter(|(key, ..)| !is_beyond_a_schema(key))
        .filter(|(key, _, bad)| problems_with(key, bad).is_empty())
        .collect();
    assert!(accepted.is_empty(), "{accepted:?}");
    for (text, problem) in [
        (
            RIG.replace("flange_link", "flange_lnk"),
            ".arm.flange_lnk is unknown",
        ),
        (
            RIG.replace("feedback_id = 17", ""),
            ".arm.motor.first.feedback_id is missing",
        ),
        (
            RIG.replace("rate_hz = 30", ""),
            ".camera.wrist.rate_hz is missing",
        ),
    ] {
        assert_eq!(problems_of(&text), [problem]);
    }
}

#[test]
fn every_key_has_a_description_for_users() {
    fn check(schema: &Value, path: &str) {
        for (key, schema) in schema["properties"].as_object().into_iter().flatten() {
            let path = format!("{path}.{key}");
            let about = schema["description"].as_str().unwrap_or_default();
            assert!(
                about.ends_with('.'),
                "{path} needs a description: {about:?}"
            );
            for word in ["`None`", "[`", "::", "Self"] {
                assert!(!about.contains(word), "{path}: {about}");
            }
            check(schema, &path);
            check(&schema["additionalProperties"], &path);
            for alternative in schema["anyOf"].as_array().into_iter().flatten() {
                check(alternative, &path);
            }
        }
    }
    check(&schema(), "");
}

#[test]
fn defaults_and_ranges_are_those_of_the_reader() {
    let schema = schema();
    let key = |path: &str| {
        path.split('.').fold(&schema, |table, key| match key {
            "NAME" => &table["additionalProperties"],
            key => &table["properties"][key],
        })
    };
    let rate = key("arm.rate_hz");
    assert_eq!(rate["default"], json!(200.0));
    assert_eq!(
        (&rate["minimum"], &rate["maximum"]),
        (&json!(1.0), &json!(2000.0))
    );
    assert_eq!(key("camera.NAME.depth.max_m")["default"], json!(6.0));
    assert_eq!(key("camera.NAME.depth.max_m")["minimum"], json!(0.0));
    assert_eq!(key("base.tag_family")["default"], "tag36h11");
    assert_eq!(key("arm.motor.NAME.id")["maximum"], json!(2046));
    assert_eq!(key("arm.address").get("default"), None);
    assert_eq!(key("train.method")["anyOf"][0]["enum"], json!(METHODS));
}

#[test]
fn committed_schema_is_up_to_date() {
    let committed = include_str!("../../../docs/reference/rig.schema.json");
    let schema = serde_json::to_string_pretty(&schema()).expect("JSON") + "\n";
    assert!(
        committed == schema,
        "run: cargo run --release -- schema > docs/reference/rig.schema.json"
    );
}
