//! Compares docs/reference/cli.md with the parser, and checks the flags that its hand-written parts
//! name. `make docs` writes the page.

use crate::cli::Cli;
use crate::flag_tests::{flags_in, flags_of, names_a_command_with};
use clap::CommandFactory;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use test_support::command_page::{CommandPage, SharedFlags, anchor, commands};

/// If this environment variable is set, the page is written instead of compared.
const WRITE: &str = "FIELDRIG_WRITE_DOCS";

/// The first line of the page.
const NOTICE: &str =
    "<!-- Written by `make docs` from the help texts and src/cli_page. Do not edit. -->\n\n";

const SHARED_FLAGS: [SharedFlags; 4] = [
    SharedFlags {
        group: "TrainingArgs",
        title: "Training flags",
    },
    SharedFlags {
        group: "DataArgs",
        title: "Image flags",
    },
    SharedFlags {
        group: "PageArgs",
        title: "Page flags",
    },
    SharedFlags {
        group: "RigFlags",
        title: "Camera and rig flags",
    },
];

fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Folder of the hand-written parts.
fn parts() -> PathBuf {
    repository().join("src/cli_page")
}

fn part(name: &str) -> Option<String> {
    std::fs::read_to_string(parts().join(format!("{name}.md"))).ok()
}

fn page() -> String {
    let page = CommandPage {
        program: &Cli::command(),
        shared: &SHARED_FLAGS,
        part: &part,
    };
    NOTICE.to_owned() + &page.render()
}

#[test]
fn page_of_the_command_line_is_rendered_from_the_parser() {
    let path = repository().join("docs/reference/cli.md");
    let rendered = page();
    if std::env::var_os(WRITE).is_some() {
        std::fs::write(&path, rendered).expect("the page can be written");
        return;
    }
    let kept = std::fs::read_to_string(&path).expect("the page exists");
    let differs = rendered
        .lines()
        .zip(kept.lines().chain(std::iter::repeat("")))
        .find(|(rendered, kept)| rendered != kept);
    assert!(
        rendered == kept,
        "docs/reference/cli.md differs from the parser: run `make docs`. First difference: {differs:?}"
    );
}

#[test]
fn every_flag_is_in_its_section() {
    let page = page();
    let mut n_flags = 0;
    for named in commands(&Cli::command()) {
        let heading = format!("# `{}`\n", named.path);
        let (_, section) = page
            .split_once(&heading)
            .expect("each command has a section");
        let section = section.split("\n## ").next().unwrap_or_default();
        for argument in named.command.get_arguments() {
            let Some(long) = argument.get_long().filter(|_| !argument.is_hide_set()) else {
                continue;
            };
            n_flags += 1;
            let is_shared = |shared: &&SharedFlags| shared.contains(&named.command, argument);
            let shared = SHARED_FLAGS.iter().find(is_shared);
            let is_linked = shared.is_none_or(|shared| section.contains(&anchor(shared.title)));
            let place = if shared.is_some() { &page } else { section };
            let is_listed =
                place.contains(&format!("| `--{long}")) || place.contains(&format!(", --{long}"));
            assert!(is_linked && is_listed, "{}: --{long}", named.path);
        }
    }
    assert!(n_flags > 150, "{n_flags} flags");
}

/// The flags of the commands that a part is about. `None` if it belongs to no command.
fn accepted_in(name: &str) -> Option<BTreeSet<String>> {
    let is_general = ["head", "shared", "end"].contains(&name);
    let is_about = |shared: &SharedFlags| anchor(shared.title) == name;
    let program = Cli::command();
    let about: Vec<_> = commands(&program)
        .into_iter()
        .filter(|named| {
            let shares = |shared: &SharedFlags| is_about(shared) && shared.is_in(&named.command);
            is_general || named.part() == name || SHARED_FLAGS.iter().any(shares)
        })
        .collect();
    let flags = about.iter().flat_map(|named| flags_of(&named.path));
    (!about.is_empty()).then(|| flags.collect())
}

#[test]
fn hand_written_parts_name_only_flags_of_their_command() {
    let mut n_parts = 0;
    let mut wrong = Vec::new();
    for entry in std::fs::read_dir(parts()).expect("a folder").flatten() {
        n_parts += 1;
        let name = entry.file_name().to_string_lossy().replace(".md", "");
        let Some(accepted) = accepted_in(&name) else {
            wrong.push(format!("{name}.md belongs to no command"));
            continue;
        };
        // The flags that every command has.
        let is_common = |flag: &str| ["help", "verbose", "version"].contains(&flag);
        let text = std::fs::read_to_string(entry.path()).expect("a text");
        for line in text.lines() {
            for flag in flags_in(line) {
                let is_known = accepted.contains(flag.name) || is_common(flag.name);
                if !is_known && !names_a_command_with(line, flag) {
                    wrong.push(format!("{name}.md: --{} in {line:?}", flag.name));
                }
            }
        }
    }
    assert_eq!(wrong, Vec::<String>::new());
    assert!(n_parts > 10, "{n_parts} parts");
}
