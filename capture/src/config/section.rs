//! Reads and checks the keys of a TOML table one by one. Keys that are never read are unknown keys.
//!
//! Problems are collected, so that a misspelled key is reported as such and not as a missing key.

use super::error::{ConfigError, SourceLocation};
use std::borrow::Cow;
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// State while a rig file is read.
#[derive(Debug)]
pub(super) struct ParseContext {
    file: String,
    /// Line of every key in the file, by dotted path.
    lines: BTreeMap<String, usize>,
    flags: BTreeSet<String>,
    problems: RefCell<Vec<ConfigError>>,
    /// Every key that was read, by dotted path with `NAME` for free names.
    accessed: RefCell<BTreeSet<String>>,
}

impl ParseContext {
    /// Records the lines of all keys; fails if the text is not TOML.
    pub(super) fn new(file: &str, text: &str, flags: BTreeSet<String>) -> Result<Self, ConfigError> {
        let mut lines = BTreeMap::new();
        let table = DeTable::parse(text).map_err(|e| ConfigError::Syntax {
            file: file.to_owned(),
            line: line_of(text, e.span().map_or(0, |span| span.start)),
            message: e.message().to_owned(),
        })?;
        note_lines(text, table.get_ref(), "", &mut lines);
        Ok(Self { file: file.to_owned(), lines, flags, problems: RefCell::default(), accessed: RefCell::default() })
    }

    /// The problem to report, if there is one. Unknown keys come first, because they explain missing ones.
    pub(super) fn into_problem(self) -> Option<ConfigError> {
        let mut problems = self.problems.into_inner();
        let first = problems.iter().position(|problem| matches!(problem, ConfigError::UnknownKey { .. })).unwrap_or(0);
        (!problems.is_empty()).then(|| problems.swap_remove(first))
    }

    /// Every key read so far.
    #[cfg(test)]
    pub(super) fn accessed(&self) -> BTreeSet<String> {
        self.accessed.borrow().clone()
    }

    fn report(&self, problem: ConfigError) {
        self.problems.borrow_mut().push(problem);
    }

    fn location(&self, key: &str) -> SourceLocation {
        // A flag may replace a whole table, and keys inside an inline table are on its line.
        let mut path = key;
        loop {
            if self.flags.contains(path) {
                return SourceLocation::Flag;
            }
            if let Some(line) = self.lines.get(path) {
                return SourceLocation::Line { file: self.file.clone(), line: *line };
            }
            match path.rsplit_once('.') {
                Some((parent, _)) => path = parent,
                None => return SourceLocation::Line { file: self.file.clone(), line: 1 },
            }
        }
    }
}

fn note_lines(text: &str, table: &DeTable<'_>, path: &str, lines: &mut BTreeMap<String, usize>) {
    for (key, value) in table {
        let path = join(path, key.get_ref());
        lines.insert(path.clone(), line_of(text, key.span().start));
        if let DeValue::Table(inner) = value.get_ref() {
            note_lines(text, inner, &path, lines);
        }
    }
}

fn line_of(text: &str, offset: usize) -> usize {
    text.bytes().take(offset).filter(|byte| *byte == b'\n').count() + 1
}

fn join(path: &str, key: &str) -> String {
    if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") }
}

/// One table of the rig file while its keys are read.
#[derive(Debug)]
pub(super) struct Section<'a> {
    context: &'a ParseContext,
    /// Dotted paths, as in the file and as in the documentation.
    path: String,
    documented_path: String,
    table: Table,
    known: Vec<&'static str>,
}

impl<'a> Section<'a> {
    /// The whole file.
    pub(super) fn root(context: &'a ParseContext, table: Table) -> Self {
        Self { context, path: String::new(), documented_path: String::new(), table, known: Vec::new() }
    }

    /// Ends the section and reports unread keys as unknown.
    pub(super) fn end(self) {
        for key in self.table.keys() {
            let close = |known: &&&str| (strsim::jaro_winkler(key, known) * 1000.0).round();
            let nearest = self.known.iter().max_by(|a, b| close(a).total_cmp(&close(b)));
            let nearest = nearest.filter(|known| strsim::jaro_winkler(key, known) > 0.7);
            let path = join(&self.path, key);
            self.context.report(ConfigError::UnknownKey {
                at: self.context.location(&path),
                key: path,
                nearest: nearest.map(|known| join(&self.path, known)),
            });
        }
    }

    /// A table inside this one; an absent one reads as empty.
    pub(super) fn section(&mut self, key: &'static str) -> Self {
        self.optional_section(key).unwrap_or_else(|| self.inner(key, key, Table::new()))
    }

    /// A table inside this one; `None` if absent.
    pub(super) fn optional_section(&mut self, key: &'static str) -> Option<Self> {
        self.known.push(key);
        match self.table.remove(key)? {
            Value::Table(table) => Some(self.inner(key, key, table)),
            other => self.invalid(key, &other, "a table"),
        }
    }

    /// The tables inside this one that have free names, with their names.
    pub(super) fn named_sections(&mut self, key: &'static str) -> Vec<(String, Self)> {
        let Some(mut parent) = self.optional_section(key) else { return Vec::new() };
        let mut sections = Vec::new();
        for (name, value) in std::mem::take(&mut parent.table) {
            match value {
                Value::Table(table) => sections.push((name.clone(), parent.inner(&name, "NAME", table))),
                other => parent.invalid(&name, &other, "a table").unwrap_or_default(),
            }
        }
        sections
    }

    fn inner(&self, key: &str, documented: &str, table: Table) -> Self {
        Section {
            context: self.context,
            path: join(&self.path, key),
            documented_path: join(&self.documented_path, documented),
            table,
            known: Vec::new(),
        }
    }

    /// A number within a range; `None` if absent or invalid.
    pub(super) fn number(&mut self, key: &'static str, range: RangeInclusive<f64>) -> Option<f64> {
        let value = self.take(key)?;
        match as_number(&value).filter(|number| range.contains(number)) {
            Some(number) => Some(number),
            None => self.invalid(key, &value, &format!("{} to {}", range.start(), range.end())),
        }
    }

    /// A nonnegative whole number within a range; `None` if absent or invalid.
    pub(super) fn whole(&mut self, key: &'static str, range: RangeInclusive<u64>) -> Option<u64> {
        let value = self.take(key)?;
        match value.as_integer().and_then(|number| u64::try_from(number).ok()).filter(|number| range.contains(number)) {
            Some(number) => Some(number),
            None => self.invalid(key, &value, &format!("whole numbers from {} to {}", range.start(), range.end())),
        }
    }

    /// A whole number within a range, which may be negative; `None` if absent or invalid.
    pub(super) fn integer(&mut self, key: &'static str, range: RangeInclusive<i64>) -> Option<i64> {
        let value = self.take(key)?;
        match value.as_integer().filter(|number| range.contains(number)) {
            Some(number) => Some(number),
            None => self.invalid(key, &value, &format!("whole numbers from {} to {}", range.start(), range.end())),
        }
    }

    /// Accepts any value of a key.
    pub(super) fn ignore(&mut self, key: &'static str) {
        self.take(key);
    }

    /// `true` or `false`; `None` if absent or invalid.
    pub(super) fn flag(&mut self, key: &'static str) -> Option<bool> {
        let value = self.take(key)?;
        value.as_bool().or_else(|| self.invalid(key, &value, "true or false"))
    }

    /// A string; `None` if absent or invalid.
    pub(super) fn text(&mut self, key: &'static str) -> Option<String> {
        match self.take(key)? {
            Value::String(text) => Some(text),
            other => self.invalid(key, &other, "text in quotes"),
        }
    }

    /// An IP address with a port; `None` if absent or invalid.
    pub(super) fn address(&mut self, key: &'static str) -> Option<SocketAddr> {
        let text = self.text(key)?;
        let allowed = "an IP address and a port in quotes, such as \"127.0.0.1:7010\"";
        text.parse().ok().or_else(|| self.invalid(key, &Value::String(text), allowed))
    }

    /// A list of strings; `None` if absent or invalid.
    pub(super) fn texts(&mut self, key: &'static str) -> Option<Vec<String>> {
        let value = self.take(key)?;
        let texts =
            value.as_array().and_then(|list| list.iter().map(|text| text.as_str().map(str::to_owned)).collect());
        texts.or_else(|| self.invalid(key, &value, "a list of strings in quotes"))
    }

    /// Exactly `N` numbers within a range; `None` if absent or invalid.
    pub(super) fn numbers<const N: usize>(
        &mut self,
        key: &'static str,
        range: RangeInclusive<f64>,
    ) -> Option<[f64; N]> {
        let value = self.take(key)?;
        let numbers: Option<Vec<f64>> = value
            .as_array()
            .and_then(|list| list.iter().map(|item| as_number(item).filter(|n| range.contains(n))).collect());
        match numbers.and_then(|numbers| <[f64; N]>::try_from(numbers).ok()) {
            Some(numbers) => Some(numbers),
            None => self.invalid(key, &value, &format!("{N} numbers from {} to {}", range.start(), range.end())),
        }
    }

    /// A list of numbers of any length; `None` if absent or invalid.
    pub(super) fn number_list(&mut self, key: &'static str) -> Option<Vec<f64>> {
        let value = self.take(key)?;
        let numbers = value.as_array().and_then(|list| list.iter().map(as_number).collect());
        numbers.or_else(|| self.invalid(key, &value, "a list of numbers"))
    }

    /// One of the given words; `None` if absent or invalid.
    pub(super) fn choice<T: Copy>(&mut self, key: &'static str, choices: &[(&str, T)]) -> Option<T> {
        let value = self.take(key)?;
        let found = choices.iter().find(|(name, _)| value.as_str() == Some(name));
        if found.is_none() {
            let names: Vec<_> = choices.iter().map(|(name, _)| format!("{name:?}")).collect();
            return self.invalid(key, &value, &names.join(", "));
        }
        found.map(|(_, choice)| *choice)
    }

    /// One of the given words, or a list of them without duplicates; `None` if absent or invalid.
    pub(super) fn choices<T: Copy + PartialEq>(&mut self, key: &'static str, choices: &[(&str, T)]) -> Option<Vec<T>> {
        let value = self.take(key)?;
        let words = value.as_array().map_or(std::slice::from_ref(&value), Vec::as_slice);
        let choice = |word: &Value| choices.iter().find(|(name, _)| word.as_str() == Some(name)).map(|found| found.1);
        let found: Vec<T> = words.iter().filter_map(choice).collect();
        let is_repeated = (1..found.len()).any(|ix| found[..ix].contains(&found[ix]));
        if found.is_empty() || found.len() < words.len() || is_repeated {
            let names: Vec<_> = choices.iter().map(|(name, _)| format!("{name:?}")).collect();
            return self.invalid(key, &value, &format!("{}, or a list of these without duplicates", names.join(", ")));
        }
        Some(found)
    }

    /// A word, or a list of words without duplicates; `None` if absent or invalid.
    pub(super) fn words(&mut self, key: &'static str) -> Option<Vec<String>> {
        let value = self.take(key)?;
        let words = value.as_array().map_or(std::slice::from_ref(&value), Vec::as_slice);
        let words: Option<Vec<String>> = words.iter().map(|word| word.as_str().map(str::to_owned)).collect();
        let is_repeated = |words: &[String]| (1..words.len()).any(|ix| words[..ix].contains(&words[ix]));
        match words.filter(|words| !words.is_empty() && !is_repeated(words)) {
            Some(words) => Some(words),
            None => self.invalid(key, &value, "a word in quotes, or a list of these without duplicates"),
        }
    }

    /// Where the value of a key comes from.
    pub(super) fn location(&self, key: &str) -> SourceLocation {
        self.context.location(&join(&self.path, key))
    }

    /// A list of the given words without duplicates, which may be empty; `None` if absent or invalid.
    pub(super) fn choices_or_none<T: Copy + PartialEq>(
        &mut self,
        key: &'static str,
        choices: &[(&str, T)],
    ) -> Option<Vec<T>> {
        if self.table.get(key).and_then(Value::as_array).is_some_and(Vec::is_empty) {
            self.take(key);
            return Some(Vec::new());
        }
        self.choices(key, choices)
    }

    /// Reports a missing key, unless its value was just reported as invalid.
    pub(super) fn missing(&self, key: &str, meaning: impl Into<Cow<'static, str>>) {
        let key = join(&self.path, key);
        let is_reported = |problem: &ConfigError| matches!(problem, ConfigError::InvalidValue { key: invalid, .. } if *invalid == key);
        if !self.context.problems.borrow().iter().any(is_reported) {
            let (file, meaning) = (self.context.file.clone(), meaning.into());
            self.context.report(ConfigError::Missing { file, key, meaning });
        }
    }

    /// Reports that the value of a key is not allowed.
    pub(super) fn invalid<T>(&self, key: &str, got: &Value, allowed: &str) -> Option<T> {
        let key = join(&self.path, key);
        let at = self.context.location(&key);
        self.context.report(ConfigError::InvalidValue {
            at,
            key,
            got: got.to_string().trim().to_owned(),
            allowed: allowed.to_owned(),
        });
        None
    }

    fn take(&mut self, key: &'static str) -> Option<Value> {
        self.known.push(key);
        self.context.accessed.borrow_mut().insert(join(&self.documented_path, key));
        self.table.remove(key)
    }
}

/// Converts integers and finite floats.
fn as_number(value: &Value) -> Option<f64> {
    #[expect(clippy::cast_precision_loss, reason = "numbers of a rig file stay far below 2^53")]
    let number = value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64))?;
    number.is_finite().then_some(number)
}
