//! Tables of flags in Markdown.

use super::list;
use clap::{Arg, Command};
use std::fmt::Write;

/// A row of a table of flags.
pub(super) struct Row {
    spelled: String,
    default: String,
    meaning: String,
}

impl Row {
    /// The row of an argument of a command.
    pub(super) fn new(command: &Command, argument: &Arg) -> Self {
        let (mut meaning, mut default) = split_default(&help(argument));
        if let Some(values) = possible_values(argument) {
            meaning = format!("{} {values}", sentence(&meaning));
        }
        let excluded = excluded(command, argument);
        if !excluded.is_empty() {
            meaning = format!(
                "{} Cannot be combined with {}",
                sentence(&meaning),
                list(&excluded, "or")
            );
        }
        let given = argument.get_default_values();
        if !given.is_empty() && argument.get_action().takes_values() {
            let given: Vec<_> = given.iter().map(|value| value.to_string_lossy()).collect();
            default = format!("`{}`", given.join(","));
        } else if argument.is_required_set() {
            "required".clone_into(&mut default);
        }
        Self {
            spelled: format!("`{}`", spelled(argument)),
            default: as_code(&default),
            meaning: as_code(&sentence(&meaning)),
        }
    }
}

/// A table of flags.
pub(super) fn of(rows: impl Iterator<Item = Row>) -> String {
    let mut text = String::from("| flag | default | meaning |\n|---|---|---|\n");
    for row in rows {
        let cells = [&row.spelled, &row.default, &row.meaning].map(|cell| cell.replace('|', "\\|"));
        let _ = writeln!(text, "| {} |", cells.join(" | "));
    }
    text
}

/// An argument as a user writes it, such as `--seconds S`.
pub(super) fn spelled(argument: &Arg) -> String {
    let Some(long) = argument.get_long() else {
        return value_names(argument);
    };
    let short = argument
        .get_short()
        .map_or_else(String::new, |short| format!("-{short}, "));
    let values = value_names(argument);
    let is_optional = argument
        .get_num_args()
        .is_some_and(|range| range.min_values() == 0);
    match () {
        () if !argument.get_action().takes_values() => format!("{short}--{long}"),
        () if is_optional && argument.is_require_equals_set() => {
            format!("{short}--{long}[={values}]")
        }
        () => format!("{short}--{long} {values}"),
    }
}

/// The names of the values of an argument.
pub(super) fn value_names(argument: &Arg) -> String {
    let names = argument.get_value_names().map(|names| names.join(" "));
    names.unwrap_or_else(|| argument.get_id().as_str().to_uppercase())
}

/// The help text of an argument, in one line. A long text with an example in several lines does
/// not fit into a table, so the short text is used.
fn help(argument: &Arg) -> String {
    let short = argument.get_help().map(ToString::to_string);
    let long = argument.get_long_help().map(ToString::to_string);
    let has_example = |text: &String| {
        text.lines()
            .any(|line| line.starts_with([' ', '{', '[', '|']))
    };
    let text = long.filter(|text| !has_example(text)).or(short);
    let text = text.unwrap_or_default();
    // Each paragraph of a long text is a sentence or several.
    let paragraphs: Vec<String> = text.split("\n\n").map(joined).collect();
    paragraphs.join(". ").replace(".. ", ". ")
}

/// A text in one line.
fn joined(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// A help text without its final `[default: ...]`, and this default.
fn split_default(help: &str) -> (String, String) {
    let found = help
        .strip_suffix(']')
        .and_then(|text| text.rsplit_once("[default: "));
    match found {
        Some((meaning, default)) => (meaning.trim_end().to_owned(), default.to_owned()),
        None => (help.to_owned(), String::new()),
    }
}

/// A sentence about the values that an argument accepts, unless its help text describes them.
fn possible_values(argument: &Arg) -> Option<String> {
    let values = argument.get_possible_values();
    let is_shown = argument.get_action().takes_values() && !argument.is_hide_possible_values_set();
    let shown: Vec<_> = values.iter().filter(|value| !value.is_hide_set()).collect();
    if !is_shown || shown.is_empty() {
        return None;
    }
    let described: Vec<String> = shown
        .iter()
        .map(|value| match value.get_help() {
            Some(help) => format!("`{}`: {}", value.get_name(), joined(&help.to_string())),
            None => format!("`{}`", value.get_name()),
        })
        .collect();
    let has_help = shown.iter().any(|value| value.get_help().is_some());
    Some(if has_help {
        format!("Values: {}", described.join("; "))
    } else {
        format!("Values: {}", described.join(", "))
    })
}

/// The flags that cannot be given together with an argument.
fn excluded(command: &Command, argument: &Arg) -> Vec<String> {
    if argument.is_global_set() {
        return Vec::new();
    }
    let others = command.get_arg_conflicts_with(argument);
    let mut names: Vec<String> = others
        .iter()
        .filter_map(|other| Some(format!("--{}", other.get_long()?)))
        .collect();
    names.sort();
    names.dedup();
    names
}

/// A help text as a sentence: with a full stop.
pub(super) fn sentence(text: &str) -> String {
    let text = joined(text);
    if text.is_empty() || text.ends_with(['.', ':', '?']) {
        text
    } else {
        text + "."
    }
}

/// A text with its flags and keys in backticks, except where it already has backticks.
pub(super) fn as_code(text: &str) -> String {
    let pieces = text.split('`').enumerate().map(|(ix, piece)| {
        if ix % 2 == 0 {
            words_as_code(piece)
        } else {
            format!("`{piece}`")
        }
    });
    pieces.collect()
}

fn words_as_code(text: &str) -> String {
    let words = text.split(' ').map(|word| {
        let start = word.find(|c: char| c != '(').unwrap_or(0);
        let (open, rest) = word.split_at(start);
        let end = rest.trim_end_matches([',', '.', ';', ':', ')']).len();
        let (core, close) = rest.split_at(end);
        let is_flag = core.starts_with("--") && core.len() > 2;
        if is_flag || is_code(core) {
            format!("{open}`{core}`{close}")
        } else {
            word.to_owned()
        }
    });
    words.collect::<Vec<_>>().join(" ")
}

/// Whether Markdown could take a word for markup, or the word names a key or a value.
fn is_code(word: &str) -> bool {
    word.contains(['_', '<', '*', '[', '{'])
        || (word.contains(':') && word.contains(|c: char| c.is_ascii_digit()))
}
