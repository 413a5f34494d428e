//! Reads, checks and writes the values of keys according to their types, and defines structs whose
//! fields are keys.
//!
//! serde is not used, because its derived code has no ranges and stops at the first problem. Here,
//! all problems are collected. A misspelled key is therefore reported as unknown, instead of the
//! correct key as missing.

use super::section::Section;
use super::table_schema::{TableSchema, one_or_more};
use serde_json::json;
use std::borrow::Cow;
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use toml::{Table, Value};

/// A type that a key can have.
pub(super) trait Key: Sized {
    /// Limits of the allowed values, in addition to those of the type.
    type Limits;

    /// Reads the value of a key. `None` if the value is absent or invalid. An invalid value is
    /// reported.
    fn read(keys: &mut Section<'_>, key: &'static str, limits: Self::Limits) -> Option<Self>;

    /// The value in a rig file; `None` if the key is omitted.
    fn write(&self) -> Option<Value>;

    /// JSON schema of the allowed values.
    fn schema(limits: Self::Limits) -> serde_json::Value;
}

/// A type that has a value for any absent key.
pub(super) trait Optional: Key {
    /// The value for an absent key. `None` if the type is a table and one of its keys is required.
    fn absent(keys: &mut Section<'_>, key: &'static str) -> Option<Self>;
}

/// A struct whose fields are keys of one table, defined by [`keys!`].
pub(super) trait Keys: Sized {
    /// Reads the fields. Reports a required key that is missing, or an invalid value without
    /// default, and returns `None`.
    fn read_keys(keys: &mut Section<'_>) -> Option<Self>;

    /// Writes the fields to a table.
    fn write_keys(&self) -> Table;

    /// Adds the keys to the schema of a table.
    fn describe(table: &mut TableSchema);
}

/// A type whose values have names in rig files, defined by [`choices!`].
pub(super) trait Choice: Copy + PartialEq + 'static {
    /// The names.
    const NAMES: &'static [(&'static str, Self)];
    /// Hint that is added to the error about an unknown name.
    const HINT: Option<&'static str> = None;
}

/// Defines the names of a type's values in rig files, and optionally a hint for unknown names.
macro_rules! choices {
    ($($Type:ty { $($Variant:ident = $name:literal),* $(; else $hint:literal)? })*) => {$(
        impl $crate::config::key::Choice for $Type {
            const NAMES: &'static [(&'static str, Self)] = &[$(($name, Self::$Variant)),*];
            $(const HINT: Option<&'static str> = Some($hint);)?
        }
    )*};
}
pub(super) use choices;

/// Defines structs whose fields are keys of one table. A field has everything that is needed to
/// read and write its key:
///
/// ```text
/// /// Description of the key
/// pub name: Type as "key" = default, in limits, within widest, required "meaning" => initial;
/// ```
///
/// - The documentation of the field is also the description of the key in the JSON schema of rig
///   files. It is therefore written for users of rig files.
/// - `as "key"`: the key, if it differs from the name of the field.
/// - `= default`: the value if the key is absent. The default may use earlier fields. Without a
///   default, the key must be required, or its type must be [`Optional`].
/// - `in limits`: the allowed values, [`Key::Limits`]. The limits may use earlier fields. An
///   earlier field without a default is an option.
/// - `within widest`: the union of all limits, if the limits use earlier fields.
/// - `required "meaning"`: an absent key is reported, with its meaning.
/// - `=> initial`: the field is not a key. The code that reads the struct sets the field
///   afterwards.
macro_rules! keys {
    ($(
        $(#[$attribute:meta])*
        $vis:vis struct $Name:ident {$(
            $(#[doc = $about:literal])*
            $field_vis:vis $field:ident: $Type:ty
                $(as $key:literal)? $(= $default:expr)? $(, in $limits:expr)? $(, within $widest:expr)?
                $(, required $meaning:expr)?
                $(=> $initial:expr)?;
        )*}
    )*) => {$(
        $(#[$attribute])*
        $vis struct $Name {$(
            $(#[doc = $about])*
            $(#[doc = concat!("\n\nDefault: `", stringify!($default), "`.")])?
            $(#[doc = concat!("\n\nAllowed: `", stringify!($limits), "`.")])?
            $field_vis $field: $Type,
        )*}

        impl $crate::config::key::Keys for $Name {
            fn read_keys(keys: &mut $crate::config::section::Section<'_>) -> Option<Self> {
                $(
                    let $field = keys!(@read keys, $Type, keys!(@key $field $($key)?), keys!(@limits $($limits)?)
                        $(, default $default)? $(, required $meaning)? $(, initial $initial)?);
                )*
                Some(Self { $($field: keys!(@value $field $(, default $default)? $(, initial $initial)?)),* })
            }

            fn write_keys(&self) -> toml::Table {
                let mut table = toml::Table::new();
                $(keys!(@write table, keys!(@key $field $($key)?), &self.$field $(, initial $initial)?);)*
                table
            }

            fn describe(table: &mut $crate::config::table_schema::TableSchema) {
                $(
                    // Defaults may use earlier fields. The widest limits may not.
                    let $field = keys!(@describe table, $Type, keys!(@key $field $($key)?), concat!($($about, "\n"),*),
                        keys!(@widest $($limits)?; $($widest)?)
                        $(, default $default)? $(, required $meaning)? $(, initial $initial)?);
                    let _ = &$field;
                )*
            }
        }

        impl $crate::config::key::Key for $Name {
            type Limits = ();

            fn read(keys: &mut $crate::config::section::Section<'_>, key: &'static str, (): ()) -> Option<Self> {
                keys.optional_section(key).and_then($crate::config::section::Section::read)
            }

            fn write(&self) -> Option<toml::Value> {
                Some(toml::Value::Table($crate::config::key::Keys::write_keys(self)))
            }

            fn schema((): ()) -> serde_json::Value {
                $crate::config::key::table_of::<Self>().into_json()
            }
        }

        impl $crate::config::key::Optional for $Name {
            fn absent(keys: &mut $crate::config::section::Section<'_>, key: &'static str) -> Option<Self> {
                keys.empty_section(key).read()
            }
        }
    )*};
    (@key $field:ident) => { stringify!($field) };
    (@key $field:ident $key:literal) => { $key };
    (@limits) => { () };
    (@limits $limits:expr) => { $limits };
    (@read $keys:ident, $Type:ty, $key:expr, $limits:expr) => { $keys.get_optional::<$Type>($key, $limits) };
    (@read $keys:ident, $Type:ty, $key:expr, $limits:expr, default $default:expr) => {
        $keys.get::<$Type>($key, $limits).unwrap_or_else(|| $default)
    };
    (@read $keys:ident, $Type:ty, $key:expr, $limits:expr, required $meaning:expr) => {
        $keys.required::<$Type>($key, $limits, $meaning)
    };
    (@read $keys:ident, $Type:ty, $key:expr, $limits:expr, initial $initial:expr) => { $initial };
    (@value $field:ident) => { $field? };
    (@value $field:ident, $with:ident $value:expr) => { $field };
    (@write $table:ident, $key:expr, $value:expr) => { $table.extend($crate::config::key::entry($key, $value)) };
    (@write $table:ident, $key:expr, $value:expr, initial $initial:expr) => {};
    (@widest ;) => { () };
    (@widest $limits:expr;) => { $limits };
    (@widest $limits:expr; $widest:expr) => { $widest };
    (@describe $table:ident, $Type:ty, $key:expr, $about:expr, $limits:expr) => {{
        // A function cannot use earlier fields.
        fn limits() -> <$Type as $crate::config::key::Key>::Limits { $limits }
        $table.add($key, $about, <$Type as $crate::config::key::Key>::schema(limits()));
        None::<$Type>
    }};
    (@describe $table:ident, $Type:ty, $key:expr, $about:expr, $limits:expr, default $default:expr) => {{
        fn limits() -> <$Type as $crate::config::key::Key>::Limits { $limits }
        let default: $Type = $default;
        $table.add_with_default(
            $key,
            $about,
            <$Type as $crate::config::key::Key>::schema(limits()),
            $crate::config::key::Key::write(&default),
        );
        default
    }};
    (@describe $table:ident, $Type:ty, $key:expr, $about:expr, $limits:expr, required $meaning:expr) => {{
        $table.require($key);
        keys!(@describe $table, $Type, $key, $about, $limits)
    }};
    (@describe $table:ident, $Type:ty, $key:expr, $about:expr, $limits:expr, initial $initial:expr) => {{
        let initial: $Type = $initial;
        initial
    }};
}
pub(super) use keys;

/// Schema of the table whose keys are the fields of a struct.
pub(super) fn table_of<T: Keys>() -> TableSchema {
    let mut table = TableSchema::default();
    T::describe(&mut table);
    table
}

/// The key with its value, unless it is omitted.
pub(super) fn entry(key: &str, value: &impl Key) -> Option<(String, Value)> {
    Some((key.to_owned(), value.write()?))
}

impl Section<'_> {
    /// The value of a key. `None` if the value is absent or invalid. An invalid value is reported.
    pub(super) fn get<T: Key>(&mut self, key: &'static str, limits: T::Limits) -> Option<T> {
        T::read(self, key, limits)
    }

    /// The value of a key that may be absent.
    pub(super) fn get_optional<T: Optional>(
        &mut self,
        key: &'static str,
        limits: T::Limits,
    ) -> Option<T> {
        T::read(self, key, limits).or_else(|| T::absent(self, key))
    }

    /// The value of a key. If the key is absent, it is reported as missing.
    pub(super) fn required<T: Key>(
        &mut self,
        key: &'static str,
        limits: T::Limits,
        meaning: impl Into<Cow<'static, str>>,
    ) -> Option<T> {
        let value = T::read(self, key, limits);
        if value.is_none() {
            self.missing(key, meaning);
        }
        value
    }

    /// Reads the whole table. Other keys in the table are unknown.
    pub(super) fn read<T: Keys>(mut self) -> Option<T> {
        let value = T::read_keys(&mut self);
        self.end();
        value
    }
}

impl<T: Key> Key for Option<T> {
    type Limits = T::Limits;

    fn read(keys: &mut Section<'_>, key: &'static str, limits: T::Limits) -> Option<Self> {
        T::read(keys, key, limits).map(Some)
    }

    fn write(&self) -> Option<Value> {
        self.as_ref().and_then(T::write)
    }

    fn schema(limits: T::Limits) -> serde_json::Value {
        T::schema(limits)
    }
}

impl<T: Key> Optional for Option<T> {
    fn absent(_: &mut Section<'_>, _: &'static str) -> Option<Self> {
        Some(None)
    }
}

impl Key for f64 {
    type Limits = RangeInclusive<Self>;

    fn read(keys: &mut Section<'_>, key: &'static str, limits: Self::Limits) -> Option<Self> {
        keys.parse(
            key,
            |value| number(value).filter(|number| limits.contains(number)),
            || {
                format!(
                    "numbers from {} to {}",
                    rounded(*limits.start()),
                    rounded(*limits.end())
                )
            },
        )
    }

    fn write(&self) -> Option<Value> {
        Some((*self).into())
    }

    fn schema(limits: Self::Limits) -> serde_json::Value {
        json!({ "type": "number", "minimum": limits.start(), "maximum": limits.end() })
    }
}

/// Rounds a limit for messages, so that limits computed by a division have few digits.
fn rounded(limit: f64) -> f64 {
    if limit.abs() < 1.0 {
        limit
    } else {
        (limit * 1e3).round() / 1e3
    }
}

/// Converts integers and finite floats.
pub(super) fn number(value: &Value) -> Option<f64> {
    #[expect(
        clippy::cast_precision_loss,
        reason = "numbers of a rig file stay far below 2^53"
    )]
    let number = value
        .as_float()
        .or_else(|| value.as_integer().map(|whole| whole as f64))?;
    // TOML has `nan` and `inf`, but no key of a rig file has a meaning for them.
    number.is_finite().then_some(number)
}

impl<const N: usize> Key for [f64; N] {
    type Limits = RangeInclusive<f64>;

    fn read(keys: &mut Section<'_>, key: &'static str, limits: Self::Limits) -> Option<Self> {
        let allowed = || format!("{N} numbers from {} to {}", limits.start(), limits.end());
        let item = |item: &Value| number(item).filter(|number| limits.contains(number));
        keys.parse(key, |value| list(value, item)?.try_into().ok(), allowed)
    }

    fn write(&self) -> Option<Value> {
        Some(self.to_vec().into())
    }

    fn schema(limits: Self::Limits) -> serde_json::Value {
        json!({ "type": "array", "items": f64::schema(limits), "minItems": N, "maxItems": N })
    }
}

impl Key for Vec<f64> {
    type Limits = ();

    fn read(keys: &mut Section<'_>, key: &'static str, (): ()) -> Option<Self> {
        keys.parse(
            key,
            |value| list(value, number),
            || "a list of numbers".into(),
        )
    }

    fn write(&self) -> Option<Value> {
        Some(self.clone().into())
    }

    fn schema((): ()) -> serde_json::Value {
        json!({ "type": "array", "items": { "type": "number" } })
    }
}

/// Converts each item of a list.
fn list<T>(value: &Value, item: impl Fn(&Value) -> Option<T>) -> Option<Vec<T>> {
    value.as_array()?.iter().map(item).collect()
}

macro_rules! whole_number {
    ($($Type:ty),*) => {$(
        impl Key for $Type {
            type Limits = RangeInclusive<Self>;

            fn read(keys: &mut Section<'_>, key: &'static str, limits: Self::Limits) -> Option<Self> {
                let allowed = || format!("whole numbers from {} to {}", limits.start(), limits.end());
                let whole = |value: &Value| Self::try_from(value.as_integer()?).ok();
                keys.parse(key, |value| whole(value).filter(|number| limits.contains(number)), allowed)
            }

            fn write(&self) -> Option<Value> {
                // Rig files contain no larger numbers.
                Some(i64::try_from(*self).unwrap_or(i64::MAX).into())
            }

            fn schema(limits: Self::Limits) -> serde_json::Value {
                json!({ "type": "integer", "minimum": limits.start(), "maximum": limits.end() })
            }
        }
    )*};
}
whole_number!(u8, u16, u32, u64, usize, i32, i64);

macro_rules! plain {
    ($($Type:ty: $allowed:literal, $schema:tt;)*) => {$(
        impl Key for $Type {
            type Limits = ();

            fn read(keys: &mut Section<'_>, key: &'static str, (): ()) -> Option<Self> {
                keys.parse(key, |value| value.clone().try_into().ok(), || $allowed.into())
            }

            fn write(&self) -> Option<Value> {
                Value::try_from(self).ok()
            }

            fn schema((): ()) -> serde_json::Value {
                json!($schema)
            }
        }
    )*};
}
plain! {
    bool: "true or false", { "type": "boolean" };
    String: "text in quotes", { "type": "string" };
    PathBuf: "a path in quotes", { "type": "string" };
    Vec<String>: "a list of strings in quotes", { "type": "array", "items": { "type": "string" } };
    SocketAddr: "an IP address and a port in quotes, such as \"127.0.0.1:7010\"", { "type": "string", "pattern": ":[0-9]+$" };
}

impl<T: Choice> Key for T {
    type Limits = ();

    fn read(keys: &mut Section<'_>, key: &'static str, (): ()) -> Option<Self> {
        keys.parse(key, choice, names_and_hint::<T>)
    }

    fn write(&self) -> Option<Value> {
        T::NAMES
            .iter()
            .find(|(_, choice)| choice == self)
            .map(|(name, _)| (*name).into())
    }

    fn schema((): ()) -> serde_json::Value {
        let names: Vec<_> = T::NAMES.iter().map(|(name, _)| *name).collect();
        json!({ "type": "string", "enum": names })
    }
}

fn choice<T: Choice>(value: &Value) -> Option<T> {
    T::NAMES
        .iter()
        .find(|(name, _)| value.as_str() == Some(name))
        .map(|(_, choice)| *choice)
}

fn names_and_hint<T: Choice>() -> String {
    let names = names::<T>();
    match T::HINT {
        Some(hint) => format!("{names}; {hint}"),
        None => names,
    }
}

fn names<T: Choice>() -> String {
    let names: Vec<_> = T::NAMES
        .iter()
        .map(|(name, _)| format!("{name:?}"))
        .collect();
    names.join(", ")
}

/// A list without duplicates. A single name does not need brackets.
impl<T: Choice> Key for Vec<T> {
    type Limits = ();

    fn read(keys: &mut Section<'_>, key: &'static str, (): ()) -> Option<Self> {
        let allowed = || format!("{}, or a list of these without duplicates", names::<T>());
        keys.parse(key, |value| distinct(value, choice), allowed)
    }

    fn write(&self) -> Option<Value> {
        Some(Value::Array(self.iter().filter_map(T::write).collect()))
    }

    fn schema((): ()) -> serde_json::Value {
        json!({ "anyOf": one_or_more(&T::schema(()), 0) })
    }
}

/// Converts a value, or the items of a list that contains no item twice.
pub(super) fn distinct<T: PartialEq>(
    value: &Value,
    item: impl Fn(&Value) -> Option<T>,
) -> Option<Vec<T>> {
    let values = value
        .as_array()
        .map_or(std::slice::from_ref(value), Vec::as_slice);
    let items: Vec<T> = values.iter().map(item).collect::<Option<_>>()?;
    (1..items.len())
        .all(|ix| !items[..ix].contains(&items[ix]))
        .then_some(items)
}
