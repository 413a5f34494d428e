//! A TOML table whose keys are read one by one. Keys that are never read are unknown keys.
//!
//! Problems are collected, so that a misspelled key is reported as unknown and the correct key is
//! not reported as missing.

use super::error::{ConfigError, SourceLocation};
use crate::nearest_name;
use files::Budget;
use std::borrow::Cow;
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// Maximum number of listed problems. Further problems are only counted. If a user gives a file of
/// another kind by mistake, it may have thousands of unknown keys.
const MAX_PROBLEMS: usize = 50;

/// State shared by all sections while a rig file is read.
#[derive(Debug)]
pub(super) struct ParseContext {
    file: String,
    /// Line of every key in the file, by dotted path.
    lines: BTreeMap<String, usize>,
    flags: BTreeSet<String>,
    problems: RefCell<Vec<ConfigError>>,
    n_more_problems: Cell<usize>,
    /// Dotted path of every key that was read. Names that the user chooses are replaced with
    /// `NAME`.
    accessed: RefCell<BTreeSet<String>>,
}

impl ParseContext {
    /// Records the lines of all keys. Fails if the text is not TOML.
    pub(super) fn new(
        file: &str,
        text: &str,
        flags: BTreeSet<String>,
    ) -> Result<Self, ConfigError> {
        let mut lines = BTreeMap::new();
        let ends: Vec<usize> = text
            .bytes()
            .enumerate()
            .filter(|(_, byte)| *byte == b'\n')
            .map(|(at, _)| at)
            .collect();
        let line_of = |offset: usize| ends.partition_point(|end| *end < offset) + 1;
        let table = DeTable::parse(text).map_err(|e| ConfigError::Syntax {
            file: file.to_owned(),
            line: line_of(e.span().map_or(0, |span| span.start)),
            message: e.message().to_owned(),
        })?;
        note_lines(&line_of, table.get_ref(), "", &mut lines);
        Ok(Self {
            file: file.to_owned(),
            lines,
            flags,
            problems: RefCell::default(),
            n_more_problems: Cell::default(),
            accessed: RefCell::default(),
        })
    }

    /// The problems, if there are any, as one error. Unknown keys come first, because they explain
    /// missing keys.
    pub(super) fn into_problem(self) -> Option<ConfigError> {
        let is_unknown = |problem: &ConfigError| matches!(problem, ConfigError::UnknownKey { .. });
        let (mut problems, others): (Vec<_>, Vec<_>) =
            self.problems.into_inner().into_iter().partition(is_unknown);
        problems.sort_by_key(|problem| match problem {
            ConfigError::UnknownKey {
                at: SourceLocation::Line { line, .. },
                ..
            } => *line,
            _ => 0,
        });
        // If the error about a misspelled key suggests the correct key, the correct key is not
        // reported as missing in addition.
        let is_meant = |problem: &ConfigError| matches!(problem, ConfigError::Missing { key, .. } if is_suggested(key, &problems));
        let others: Vec<_> = others
            .into_iter()
            .filter(|problem| !is_meant(problem))
            .collect();
        problems.extend(others);
        let first = (!problems.is_empty()).then(|| problems.remove(0))?;
        Some(if problems.is_empty() {
            first
        } else {
            ConfigError::Several {
                first: Box::new(first),
                others: problems,
                n_more: self.n_more_problems.get(),
            }
        })
    }

    /// Every key read so far.
    #[cfg(test)]
    pub(super) fn accessed(&self) -> BTreeSet<String> {
        self.accessed.borrow().clone()
    }

    fn report(&self, problem: ConfigError) {
        let mut problems = self.problems.borrow_mut();
        if problems.len() < MAX_PROBLEMS {
            problems.push(problem);
        } else {
            self.n_more_problems.update(|n| n + 1);
        }
    }

    /// The place that sets the value of a key. The key is a dotted path.
    pub(super) fn location(&self, key: &str) -> SourceLocation {
        // A flag may replace a whole table, and keys inside an inline table are on the line of that
        // table. Parent tables are therefore searched as well.
        let mut path = key;
        loop {
            if self.flags.contains(path) {
                return SourceLocation::Flag;
            }
            if let Some(line) = self.lines.get(path) {
                return SourceLocation::Line {
                    file: self.file.clone(),
                    line: *line,
                };
            }
            match path.rsplit_once('.') {
                Some((parent, _)) => path = parent,
                None => {
                    return SourceLocation::Line {
                        file: self.file.clone(),
                        line: 1,
                    };
                }
            }
        }
    }
}

/// Whether an unknown key is probably a misspelling of `key`.
fn is_suggested(key: &str, problems: &[ConfigError]) -> bool {
    problems
        .iter()
        .any(|problem| matches!(problem, ConfigError::UnknownKey { nearest: Some(meant), .. } if meant == key))
}

fn note_lines(
    line_of: &impl Fn(usize) -> usize,
    table: &DeTable<'_>,
    path: &str,
    lines: &mut BTreeMap<String, usize>,
) {
    for (key, value) in table {
        let path = join(path, key.get_ref());
        lines.insert(path.clone(), line_of(key.span().start));
        if let DeValue::Table(inner) = value.get_ref() {
            note_lines(line_of, inner, &path, lines);
        }
    }
}

fn join(path: &str, key: &str) -> String {
    if path.is_empty() {
        key.to_owned()
    } else {
        format!("{path}.{key}")
    }
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
        Self {
            context,
            path: String::new(),
            documented_path: String::new(),
            table,
            known: Vec::new(),
        }
    }

    /// Ends the section and reports unread keys as unknown.
    pub(super) fn end(self) {
        for key in self.table.keys() {
            // The search for similar names is not needed for a problem that is only counted.
            if self.context.problems.borrow().len() >= MAX_PROBLEMS {
                self.context.n_more_problems.update(|n| n + 1);
                continue;
            }
            let nearest = nearest_name(key, self.known.iter().copied());
            let path = join(&self.path, key);
            self.context.report(ConfigError::UnknownKey {
                at: self.context.location(&path),
                key: path,
                nearest: nearest.map(|known| join(&self.path, known)),
            });
        }
    }

    /// Returns an empty table instead of a table inside this one.
    pub(super) fn empty_section(&self, key: &str) -> Self {
        self.inner(key, key, Table::new())
    }

    /// A table inside this one. An absent table reads as an empty one.
    pub(super) fn section(&mut self, key: &'static str) -> Self {
        self.optional_section(key)
            .unwrap_or_else(|| self.empty_section(key))
    }

    /// A table inside this one; `None` if absent.
    pub(super) fn optional_section(&mut self, key: &'static str) -> Option<Self> {
        self.known.push(key);
        match self.table.remove(key)? {
            Value::Table(table) => Some(self.inner(key, key, table)),
            other => self.invalid(key, &other, "a table"),
        }
    }

    /// The tables inside this one whose names the user chooses, with their names. More tables than
    /// [`Budget::RIG_TABLES`] are a problem. The program that wrote the file probably has an error.
    pub(super) fn named_sections(&mut self, key: &'static str) -> Vec<(String, Self)> {
        let Some(mut parent) = self.optional_section(key) else {
            return Vec::new();
        };
        let n = parent.table.len();
        let budget = Budget::RIG_TABLES;
        if budget.check_elements(n as u64).is_err() {
            let got = Value::String(format!("{n} tables"));
            self.invalid::<()>(
                key,
                &got,
                &format!("at most {} tables", budget.max_elements),
            );
            parent.table.clear();
        }
        let mut sections = Vec::new();
        for (name, value) in std::mem::take(&mut parent.table) {
            match value {
                Value::Table(table) => {
                    sections.push((name.clone(), parent.inner(&name, "NAME", table)))
                }
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

    /// Converts the value of a key; `None` if it is absent or invalid.
    pub(super) fn parse<T>(
        &mut self,
        key: &'static str,
        convert: impl FnOnce(&Value) -> Option<T>,
        allowed: impl FnOnce() -> String,
    ) -> Option<T> {
        let value = self.take(key)?;
        convert(&value).or_else(|| self.invalid(key, &value, &allowed()))
    }

    /// Whether the file or a flag sets a key that is not yet read.
    pub(super) fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// Where the value of a key comes from.
    pub(super) fn location(&self, key: &str) -> SourceLocation {
        self.context.location(&join(&self.path, key))
    }

    /// Reports a missing key, unless its value was just reported as invalid.
    pub(super) fn missing(&self, key: &str, meaning: impl Into<Cow<'static, str>>) {
        let key = join(&self.path, key);
        let is_reported = |problem: &ConfigError| matches!(problem, ConfigError::InvalidValue { key: other, .. } if *other == key);
        // The temporary borrow ends with the condition, because `report` borrows the list again.
        if !self.context.problems.borrow().iter().any(is_reported) {
            self.context.report(ConfigError::Missing {
                file: self.context.file.clone(),
                key,
                meaning: meaning.into(),
            });
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

    /// Checks the name of the table, which is also used for frames and topics.
    pub(super) fn check_name(&self, name: &str) {
        let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        if name.is_empty() || !name.chars().all(is_plain) {
            self.invalid::<()>(
                "name",
                &Value::String(name.to_owned()),
                "letters, digits, _ and -",
            );
        }
    }

    /// Takes the value of a key, and marks the key as known.
    pub(super) fn take(&mut self, key: &'static str) -> Option<Value> {
        self.known.push(key);
        self.context
            .accessed
            .borrow_mut()
            .insert(join(&self.documented_path, key));
        self.table.remove(key)
    }
}
