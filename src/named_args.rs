//! Parser of flags that accept one of several names.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

/// Returns a parser for values of a library, each with its name and its description in the help.
pub(crate) fn one_of<T: Copy + Send + Sync + 'static>(
    values: impl IntoIterator<Item = (T, &'static str, &'static str)>,
) -> impl TypedValueParser<Value = T> {
    let values: Vec<_> = values.into_iter().collect();
    let shown: Vec<_> = values
        .iter()
        .map(|(_, name, description)| PossibleValue::new(*name).help(*description))
        .collect();
    PossibleValuesParser::new(shown).try_map(move |given| {
        let found = values.iter().find(|(_, name, _)| *name == given);
        found.map(|(value, ..)| *value).ok_or("unknown name")
    })
}
