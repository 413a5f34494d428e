//! Checks that the parser accepts every command in README and guides, and that these pages name
//! only flags that exist.

use crate::cli::Cli;
use crate::flag_tests::{flags_in, flags_of};
use clap::{CommandFactory, Parser};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Flags of other programs that the prose names: cargo, curl, pkg-config, browsers, converters and senders.
const OF_OTHER_PROGRAMS: [&str; 9] = [
    "cacert",
    "calibration",
    "camera-in-body",
    "features",
    "insecure",
    "modversion",
    "no-sandbox",
    "release",
    "topic",
];

fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// README and guides: their names and texts.
fn pages() -> Vec<(String, String)> {
    let guides = std::fs::read_dir(repository().join("docs/guide")).expect("a folder");
    let mut paths: Vec<PathBuf> = guides
        .map(|entry| entry.expect("readable").path())
        .collect();
    paths.push(repository().join("README.md"));
    paths.sort();
    let read = |path: PathBuf| {
        let text = std::fs::read_to_string(&path).expect("a text");
        (path.to_string_lossy().into_owned(), text)
    };
    paths.into_iter().map(read).collect()
}

#[test]
fn commands_in_the_guides_are_accepted() {
    let commands = test_support::documented_commands(repository());
    assert!(commands.len() > 50, "{} commands", commands.len());
    let refused: Vec<String> = commands
        .iter()
        .filter_map(|command| {
            let words = std::iter::once("fieldrig").chain(command.words.iter().map(String::as_str));
            let error = Cli::try_parse_from(words).err()?;
            let reason = error.to_string();
            let reason = reason.lines().next().unwrap_or_default();
            Some(format!(
                "{}: fieldrig {}: {reason}",
                command.page,
                command.words.join(" ")
            ))
        })
        .collect();
    assert_eq!(refused, Vec::<String>::new());
}

/// The inline code of a page, outside of code blocks.
fn inline_code(page: &str) -> Vec<&str> {
    let mut is_block = false;
    let prose = page.lines().filter(|line| {
        let is_fence = line.trim_start().starts_with("```");
        is_block ^= is_fence;
        !is_block && !is_fence
    });
    prose
        .flat_map(|line| line.split('`').skip(1).step_by(2))
        .collect()
}

/// The command that inline code such as `fieldrig calibrate scene` names, if it exists.
fn named_command(code: &str) -> Result<Option<String>, String> {
    let Some(rest) = code.strip_prefix("fieldrig ") else {
        return Ok(None);
    };
    let cli = Cli::command();
    let mut command = &cli;
    let mut path = Vec::new();
    for word in rest.split_whitespace() {
        match command.find_subcommand(word) {
            Some(found) => command = found,
            None => break,
        }
        path.push(word);
    }
    let is_placeholder = rest.starts_with(|c: char| !c.is_ascii_lowercase());
    if path.is_empty() && !is_placeholder {
        return Err(format!("there is no command {code:?}"));
    }
    Ok((!path.is_empty()).then(|| path.join(" ")))
}

#[test]
fn prose_of_the_guides_names_only_flags_that_exist() {
    let cli = Cli::command();
    let all: BTreeSet<String> = cli
        .get_subcommands()
        .flat_map(|command| flags_of(command.get_name()))
        .collect();
    let mut wrong = Vec::new();
    let mut n_flags = 0;
    for (page, text) in pages() {
        for code in inline_code(&text) {
            let accepted = match named_command(code) {
                Ok(Some(path)) => flags_of(&path),
                Ok(None) => all.clone(),
                Err(reason) => {
                    wrong.push(format!("{page}: {reason}"));
                    continue;
                }
            };
            for flag in flags_in(code) {
                n_flags += 1;
                let is_common = ["help", "version", "verbose"].contains(&flag.name);
                if !accepted.contains(flag.name)
                    && !is_common
                    && !OF_OTHER_PROGRAMS.contains(&flag.name)
                {
                    wrong.push(format!("{page}: --{} in {code:?}", flag.name));
                }
            }
        }
    }
    assert_eq!(wrong, Vec::<String>::new());
    assert!(n_flags > 60, "{n_flags} flags");
}
