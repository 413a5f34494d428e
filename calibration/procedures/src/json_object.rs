//! Reads JSON objects, with errors that name the file and the field.

use kinematics::{Transform, transform};
use messages::BadInput;
use serde::de::{Deserialize, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};
use std::fmt::Formatter;

/// Parses JSON. A key that occurs twice in one object is an error, because only its last value
/// would be used otherwise.
pub(crate) fn parse(text: &str) -> serde_json::Result<Value> {
    serde_json::from_str(text).map(|Unique(value)| value)
}

/// A value whose objects have no repeated keys.
struct Unique(Value);

impl<'de> Deserialize<'de> for Unique {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(UniqueVisitor).map(Self)
    }
}

struct UniqueVisitor;

impl<'de> Visitor<'de> for UniqueVisitor {
    type Value = Value;

    fn expecting(&self, formatter: &mut Formatter<'_>) -> std::fmt::Result {
        // This text is never shown, because values of all kinds are accepted.
        formatter.write_str("a value")
    }

    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_bool<E>(self, value: bool) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_i64<E>(self, value: i64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_u64<E>(self, value: u64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_f64<E>(self, value: f64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_str<E>(self, value: &str) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Value, A::Error> {
        let mut values = Vec::new();
        while let Some(Unique(value)) = list.next_element()? {
            values.push(value);
        }
        Ok(values.into())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut object: A) -> Result<Value, A::Error> {
        let mut map = Map::new();
        while let Some((key, Unique(value))) = object.next_entry::<String, Unique>()? {
            // `serde_json` would silently keep the last value.
            if map.contains_key(&key) {
                return Err(A::Error::custom(format_args!(
                    "the key {key:?} occurs twice; keep one of them"
                )));
            }
            map.insert(key, value);
        }
        Ok(map.into())
    }
}

/// An object in a JSON file.
#[derive(Clone, Debug)]
pub(crate) struct JsonObject<'a> {
    file: &'a str,
    /// Path of the object in the file, such as `samples[3]`. It is empty for the whole file.
    path: String,
    map: &'a Map<String, Value>,
}

impl<'a> JsonObject<'a> {
    /// Rejects values that are not objects, and objects with keys other than `known`.
    pub(crate) fn new(
        file: &'a str,
        path: String,
        value: &'a Value,
        known: &[&str],
    ) -> Result<Self, BadInput> {
        let place = if path.is_empty() {
            file.to_owned()
        } else {
            format!("{file}: {path}")
        };
        let Some(map) = value.as_object() else {
            return Err(BadInput(format!(
                "{place}: {}, expected an object",
                kind_of(value)
            )));
        };
        // A misspelled optional key would otherwise be ignored.
        if let Some(unknown) = map.keys().find(|key| !known.contains(&key.as_str())) {
            let hint = match capture::nearest_name(unknown, known.iter().copied()) {
                Some(key) => format!("did you mean {key:?}?"),
                None => format!("the keys are {}", known.join(", ")),
            };
            return Err(BadInput(format!(
                "{place}: unknown key {unknown:?}; {hint}"
            )));
        }
        Ok(Self { file, path, map })
    }

    /// An error about a field.
    pub(crate) fn invalid(&self, key: &str, why: impl std::fmt::Display) -> BadInput {
        BadInput(format!("{}: {}: {why}", self.file, self.path_of(key)))
    }

    fn path_of(&self, key: &str) -> String {
        if self.path.is_empty() {
            key.to_owned()
        } else {
            format!("{}.{key}", self.path)
        }
    }

    /// The value of a field. `null` counts as missing.
    pub(crate) fn get(&self, key: &str) -> Option<&'a Value> {
        self.map.get(key).filter(|value| !value.is_null())
    }

    pub(crate) fn required<T>(&self, key: &str, value: Option<T>) -> Result<T, BadInput> {
        value.ok_or_else(|| self.invalid(key, "missing"))
    }

    pub(crate) fn text(&self, key: &str) -> Result<Option<&'a str>, BadInput> {
        self.get(key)
            .map(|value| {
                value.as_str().ok_or_else(|| {
                    self.invalid(key, format!("{}, expected a string", kind_of(value)))
                })
            })
            .transpose()
    }

    pub(crate) fn numbers(&self, key: &str) -> Result<Option<Vec<f64>>, BadInput> {
        let Some(value) = self.get(key) else {
            return Ok(None);
        };
        let Some(list) = value.as_array() else {
            return Err(self.invalid(
                key,
                format!("{}, expected an array of numbers", kind_of(value)),
            ));
        };
        let numbers: Option<Vec<f64>> = list.iter().map(Value::as_f64).collect();
        numbers
            .map(Some)
            .ok_or_else(|| self.invalid(key, "expected an array of numbers"))
    }

    pub(crate) fn array<const N: usize>(&self, key: &str) -> Result<Option<[f64; N]>, BadInput> {
        let Some(numbers) = self.numbers(key)? else {
            return Ok(None);
        };
        // The length is kept for the message, because the conversion consumes the list.
        let n = numbers.len();
        numbers
            .try_into()
            .map(Some)
            .map_err(|_| self.invalid(key, format!("{n} numbers, expected {N}")))
    }

    pub(crate) fn transform(&self, key: &str) -> Result<Option<Transform>, BadInput> {
        self.get(key)
            .map(|value| transform_of(value).map_err(|why| self.invalid(key, why)))
            .transpose()
    }

    pub(crate) fn list(&self, key: &str) -> Result<&'a [Value], BadInput> {
        let value = self.required(key, self.get(key))?;
        let list = value
            .as_array()
            .ok_or_else(|| self.invalid(key, format!("{}, expected an array", kind_of(value))))?;
        Ok(list)
    }

    /// The object in a field.
    pub(crate) fn object(&self, key: &str, known: &[&str]) -> Result<Option<Self>, BadInput> {
        self.get(key)
            .map(|value| Self::new(self.file, self.path_of(key), value, known))
            .transpose()
    }

    /// The objects in a list.
    pub(crate) fn objects(&self, key: &str, known: &[&str]) -> Result<Vec<Self>, BadInput> {
        let path = self.path_of(key);
        let object = |(ix, value): (usize, &'a Value)| {
            Self::new(self.file, format!("{path}[{ix}]"), value, known)
        };
        self.list(key)?.iter().enumerate().map(object).collect()
    }
}

/// The transform of a matrix in JSON. The matrix is four lists of four numbers or one list of 16
/// numbers, row by row.
fn transform_of(value: &Value) -> Result<Transform, String> {
    let rows = value.as_array().map_or(0, Vec::len);
    let row_of = |row: &Value| row.as_array().filter(|row| row.len() == 4).cloned();
    let given = value.as_array().cloned().unwrap_or_default();
    // The list has four rows of four numbers, or it contains the numbers directly. Other shapes
    // fail in the conversion below.
    let flat = match given.iter().map(row_of).collect::<Option<Vec<_>>>() {
        Some(rows) => rows.concat(),
        None => given,
    };
    let numbers: Option<Vec<f64>> = flat.iter().map(Value::as_f64).collect();
    let numbers: Option<[f64; 16]> = numbers.and_then(|numbers| numbers.try_into().ok());
    // If there are one to three rows, the last row was probably forgotten, so the error includes a
    // hint.
    let numbers = numbers.ok_or_else(|| match rows {
        1..=3 => format!("must be a matrix of 4 x 4 numbers, row by row; found {rows} rows"),
        _ => "must be a matrix of 4 x 4 numbers, row by row".to_owned(),
    })?;
    transform::from_rows(&numbers).map_err(|error| error.to_string())
}

fn kind_of(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "a boolean",
        Value::Number(_) => "a number",
        Value::String(_) => "a string",
        Value::Array(_) => "an array",
        Value::Object(_) => "an object",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn error<T>(result: Result<T, BadInput>) -> String {
        result.err().expect("an error").to_string()
    }

    #[test]
    fn repeated_keys_are_refused_and_other_json_is_read_unchanged() {
        let text = r#"{"a": [null, true, -7, 18446744073709551615, 0.1, "text", {"a": {}}], "b": {"a": []}}"#;
        let expected: Value = serde_json::from_str(text).expect("JSON");
        assert_eq!(parse(text).expect("JSON"), expected);
        for (text, line) in [
            (r#"{"a": 1, "a": 1}"#, 1),
            ("[{},\n{\"b\": {\"a\": 1, \"c\": 2,\n\"a\": 2}}]", 3),
        ] {
            let error = parse(text).expect_err("a repeated key").to_string();
            let expected =
                format!("the key \"a\" occurs twice; keep one of them at line {line} column ");
            assert!(error.starts_with(&expected), "{error}");
        }
        assert!(parse(r#"{"a": 1e999}"#).is_err() && parse("{} {}").is_err());
    }

    #[test]
    fn errors_name_the_field() {
        let value = json!({"samples": [{}, {"base_from_flange": [[1, 2]], "image": 7, "joints": [1, "2"]}]});
        let file =
            JsonObject::new("s.json", String::new(), &value, &["samples"]).expect("an object");
        let known = ["base_from_flange", "image", "joints"];
        let samples = file.objects("samples", &known).expect("objects");
        assert_eq!(
            error(samples[1].text("image")),
            "s.json: samples[1].image: a number, expected a string"
        );
        assert!(
            error(samples[1].numbers("joints")).starts_with("s.json: samples[1].joints: expected")
        );
        assert!(
            error(samples[1].transform("base_from_flange"))
                .contains("samples[1].base_from_flange: must be a matrix")
        );
        assert_eq!(
            error(samples[0].required("image", samples[0].get("image"))),
            "s.json: samples[0].image: missing"
        );
        let bad = json!({"samples": [{"base_to_flange": 1}]});
        let file = JsonObject::new("s.json", String::new(), &bad, &["samples"]).expect("an object");
        let message = error(file.objects("samples", &known));
        assert!(
            message.contains(
                "samples[0]: unknown key \"base_to_flange\"; did you mean \"base_from_flange\"?"
            ),
            "{message}"
        );
        let message = error(JsonObject::new(
            "s.json",
            String::new(),
            &json!({"zzz": 1}),
            &["samples", "setup"],
        ));
        assert_eq!(
            message,
            "s.json: unknown key \"zzz\"; the keys are samples, setup"
        );
        assert_eq!(
            error(JsonObject::new("s.json", String::new(), &json!([]), &[])),
            "s.json: an array, expected an object"
        );
    }
}
