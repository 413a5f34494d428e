//! Values of TOML tables.

use toml::{Table, Value};

/// A table of the keys that have a value.
pub(super) fn table<const N: usize>(entries: [(&str, Option<Value>); N]) -> Table {
    entries.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?))).collect()
}

pub(super) fn is(value: impl Into<Value>) -> Option<Value> {
    Some(value.into())
}

pub(super) fn whole(number: u64) -> Option<Value> {
    // Rig files contain no larger numbers.
    is(i64::try_from(number).unwrap_or(i64::MAX))
}

pub(super) fn name_of<T: PartialEq>(choices: &[(&'static str, T)], choice: &T) -> Option<Value> {
    choices.iter().find(|(_, candidate)| candidate == choice).map(|(name, _)| Value::from(*name))
}
