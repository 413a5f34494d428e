//! JSON schema of one table of a rig file.

use serde_json::{Map, Value, json};

/// Names of frames and topics.
pub(super) const PLAIN_NAME: &str = "^[A-Za-z0-9_-]+$";

/// Schema of a table of a rig file.
#[derive(Clone, Debug, Default)]
pub(super) struct TableSchema {
    keys: Map<String, Value>,
    required: Vec<Value>,
    /// Rules for some values of the table.
    conditions: Vec<Value>,
}

impl TableSchema {
    /// Adds a key that is absent in most rig files, with the value that then applies.
    pub(super) fn add_with_default(
        &mut self,
        key: &str,
        about: &str,
        schema: Value,
        default: Option<toml::Value>,
    ) {
        self.add(key, about, schema);
        // The keys of a table have their own defaults. An empty text or list stands for no value.
        let default = default.and_then(|value| match value {
            toml::Value::Table(_) => None,
            toml::Value::String(text) if text.is_empty() => None,
            toml::Value::Array(items) if items.is_empty() => None,
            other => serde_json::to_value(other).ok(),
        });
        self.refine(key, |schema| {
            schema.extend(default.map(|default| ("default".to_owned(), default)));
        });
    }

    /// Adds a table.
    pub(super) fn table(&mut self, key: &str, about: &str, table: Self) {
        self.add(key, about, table.into_json());
    }

    /// Adds a table of tables whose names the user chooses. The names match a regular expression.
    pub(super) fn named(&mut self, key: &str, about: &str, names: &str, table: Self) {
        let tables = json!({
            "type": "object",
            "propertyNames": { "pattern": names },
            "additionalProperties": table.into_json(),
        });
        self.add(key, about, tables);
    }

    /// Adds a key.
    ///
    /// * `about`: lines of its documentation.
    /// * `schema`: its values, for the widest limits that the key can have.
    pub(super) fn add(&mut self, key: &str, about: &str, mut schema: Value) {
        if let Value::Object(fields) = &mut schema {
            let about = about.split_whitespace().collect::<Vec<_>>().join(" ");
            fields.insert("description".to_owned(), about.into());
        }
        self.keys.insert(key.to_owned(), schema);
    }

    /// Marks a key as required.
    pub(super) fn require(&mut self, key: &str) {
        self.required.push(key.into());
    }

    /// Marks a key as optional.
    pub(super) fn accept_absent(&mut self, key: &str) {
        self.required.retain(|required| required != key);
    }

    /// Adds a rule: a schema for the whole table.
    pub(super) fn condition(&mut self, rule: Value) {
        self.conditions.push(rule);
    }

    /// Changes the schema of a key.
    pub(super) fn refine(&mut self, key: &str, change: impl FnOnce(&mut Map<String, Value>)) {
        if let Some(Value::Object(schema)) = self.keys.get_mut(key) {
            change(schema);
        }
    }

    /// The schema as JSON. Other keys are not allowed.
    pub(super) fn into_json(self) -> Value {
        let mut schema = json!({
            "type": "object",
            "properties": self.keys,
            "additionalProperties": false,
        });
        if !self.required.is_empty() {
            schema["required"] = self.required.into();
        }
        if !self.conditions.is_empty() {
            schema["allOf"] = self.conditions.into();
        }
        schema
    }
}

/// The alternatives of a value, or a list of such values without duplicates.
pub(super) fn one_or_more(one: &Value, min_items: usize) -> Value {
    let list = json!({ "type": "array", "items": one, "uniqueItems": true, "minItems": min_items });
    json!([one, list])
}
