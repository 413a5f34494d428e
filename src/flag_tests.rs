//! Checks that messages name only flags of the command that prints them.

use crate::cli::Cli;
use clap::CommandFactory;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use syn::buffer::{Cursor, TokenBuffer};
use syn::visit::Visit;
use syn::{Attribute, Item, LitStr, Macro, Meta};

/// Source files or folders, and the commands that print their messages. All these commands must
/// accept a flag in a message, unless the message names a command that accepts it.
const PRINTED_BY: [(&str, &[&str]); 24] = [
    ("bench/src", &["bench"]),
    ("calibration/procedures/src", &["calibrate"]),
    ("calibration/src/hand_eye", &["calibrate hand-eye"]),
    ("keyframe/src/error.rs", &["train", "eval", "bench"]),
    ("session/src/camera_path.rs", &["render"]),
    ("session/src/checkpoints.rs", &["run", "train"]),
    (
        "session/src/corrected_rig.rs",
        &["calibrate intrinsics", "calibrate hand-eye"],
    ),
    ("session/src/data.rs", &["train", "eval", "bench"]),
    ("session/src/depth_from.rs", &["train"]),
    ("session/src/replay.rs", &["train"]),
    ("session/src/run_folder.rs", &["run", "train"]),
    ("session/src/scene_calibration.rs", &["calibrate scene"]),
    ("session/src/session/persistence.rs", &["run", "train"]),
    ("session/src/training.rs", &["train", "bench"]),
    (
        "session/src/training_options.rs",
        &["run", "train", "bench"],
    ),
    ("src/commands/bench", &["bench"]),
    ("src/commands/calibrate", &["calibrate"]),
    (
        "src/page_args.rs",
        &["run", "view", "calibrate intrinsics", "calibrate hand-eye"],
    ),
    (
        "targets/src/error.rs",
        &[
            "calibrate intrinsics",
            "calibrate hand-eye",
            "calibrate target",
        ],
    ),
    ("trainer/src/splat/trainer", &["run", "train", "bench"]),
    (
        "viz/src/error.rs",
        &["run", "view", "calibrate intrinsics", "calibrate hand-eye"],
    ),
    // These build command lines for other commands.
    ("session/src/next_commands.rs", &["eval", "export"]),
    ("src/commands/bench/live.rs", &["run"]),
    ("src/commands/bench/run_flags.rs", &["run"]),
];

/// Exceptions: flags in messages of a command that does not accept them.
const NOT_PRINTED: [(&str, &str); 2] = [
    // A flag for `eval`, which is printed as a command to run next.
    ("src/commands/run.rs", "rig"),
    // Replaced by `--params` in messages.
    ("session/src/scene_calibration.rs", "refine"),
];

/// Long flags of a command such as `train` or `bench curve`, and of its subcommands.
fn flags_of(path: &str) -> BTreeSet<String> {
    let cli = Cli::command();
    let command = path.split(' ').fold(&cli, |command, name| {
        command
            .find_subcommand(name)
            .unwrap_or_else(|| panic!("there is no command {path:?}"))
    });
    let mut flags = BTreeSet::new();
    let mut waiting = vec![command];
    while let Some(command) = waiting.pop() {
        flags.extend(
            command
                .get_arguments()
                .filter_map(|argument| argument.get_long())
                .map(str::to_owned),
        );
        waiting.extend(command.get_subcommands());
    }
    flags
}

fn is_in(file: &str, place: &str) -> bool {
    file.strip_prefix(place)
        .is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

/// The flags of each command that prints the messages of a file.
fn accepted_in(file: &str) -> Vec<BTreeSet<String>> {
    // The longest place is the most specific one.
    let places = PRINTED_BY.iter().filter(|(place, _)| is_in(file, place));
    if let Some((_, commands)) = places.max_by_key(|(place, _)| place.len()) {
        return match is_in(file, "session/src/next_commands.rs") {
            true => vec![
                commands
                    .iter()
                    .flat_map(|command| flags_of(command))
                    .collect(),
            ],
            false => commands.iter().map(|command| flags_of(command)).collect(),
        };
    }
    let own = file
        .strip_prefix("src/commands/")
        .and_then(|rest| rest.split(['/', '.']).next());
    let is_command = |name: &&str| Cli::command().find_subcommand(name).is_some();
    let renamed = own.map(|name| if name == "move_arm" { "move" } else { name });
    vec![
        renamed
            .filter(is_command)
            .map_or_else(BTreeSet::new, flags_of),
    ]
}

/// A flag in a text, and the text before it.
#[derive(Clone, Copy, Debug)]
struct NamedFlag<'a> {
    name: &'a str,
    before: &'a str,
}

/// The flags that a text names, such as `--seconds`.
fn flags_in(text: &str) -> Vec<NamedFlag<'_>> {
    let named = text.match_indices("--").filter_map(|(at, dashes)| {
        let (before, rest) = (&text[..at], &text[at + dashes.len()..]);
        let is_part = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
        let name = &rest[..rest.find(|c: char| !is_part(c)).unwrap_or(rest.len())];
        let begins =
            !before.ends_with(|c: char| c.is_alphanumeric() || matches!(c, '-' | '"' | '_'));
        // Variables of style sheets.
        let is_variable = before.ends_with("var(");
        let is_flag = begins && !is_variable && name.starts_with(|c: char| c.is_ascii_lowercase());
        is_flag.then_some(NamedFlag { name, before })
    });
    named.collect()
}

/// Whether a text names a command that accepts a flag: as `` `train` ``, `fieldrig train`, or
/// directly before the flag.
fn names_a_command_with(text: &str, flag: NamedFlag<'_>) -> bool {
    let is_named = |name: &str| {
        text.contains(&format!("fieldrig {name}"))
            || text.contains(&format!("`{name}`"))
            || flag.before.ends_with(&format!("{name} "))
    };
    // Flags of cargo in advice on how to build.
    let is_of_cargo = ["features", "release"].contains(&flag.name) && text.contains("build");
    let cli = Cli::command();
    let mut commands = cli.get_subcommands().map(|command| command.get_name());
    is_of_cargo || commands.any(|name| is_named(name) && flags_of(name).contains(flag.name))
}

/// The texts of a file, without those of tests, documentation and help.
#[derive(Default)]
struct Texts(Vec<String>);

impl Texts {
    fn add_all(&mut self, mut tokens: Cursor<'_>) {
        loop {
            if let Some((literal, rest)) = tokens.literal() {
                self.0.extend(
                    syn::parse_str::<LitStr>(&literal.to_string())
                        .ok()
                        .map(|text| text.value()),
                );
                tokens = rest;
            } else if let Some((punct, rest)) = tokens.punct() {
                // An attribute, usually documentation, follows a number sign.
                let attribute = rest.any_group().filter(|_| punct.as_char() == '#');
                tokens = attribute.map_or(rest, |(_, _, _, after)| after);
            } else if let Some((inside, _, _, rest)) = tokens.any_group() {
                self.add_all(inside);
                tokens = rest;
            } else if let Some((_, rest)) = tokens.token_tree() {
                tokens = rest;
            } else {
                break;
            }
        }
    }
}

/// Whether an attribute such as `#[cfg(test)]` restricts an item to tests.
fn is_for_tests(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        let Meta::List(list) = &attribute.meta else {
            return false;
        };
        let condition = list.tokens.to_string();
        list.path.is_ident("cfg")
            && condition
                .split(|c: char| !c.is_alphanumeric())
                .any(|word| word == "test")
    })
}

impl<'ast> Visit<'ast> for Texts {
    fn visit_item(&mut self, item: &'ast Item) {
        if !matches!(item, Item::Mod(module) if is_for_tests(&module.attrs)) {
            syn::visit::visit_item(self, item);
        }
    }

    /// Only the messages of errors.
    fn visit_attribute(&mut self, attribute: &'ast Attribute) {
        if let Meta::List(list) = &attribute.meta
            && list.path.is_ident("error")
        {
            self.add_all(TokenBuffer::new2(list.tokens.clone()).begin());
        }
    }

    fn visit_macro(&mut self, invoked: &'ast Macro) {
        self.add_all(TokenBuffer::new2(invoked.tokens.clone()).begin());
    }

    fn visit_lit_str(&mut self, text: &'ast LitStr) {
        self.0.push(text.value());
    }
}

/// Source files of all crates, except tests.
fn source_files(root: &Path) -> Vec<PathBuf> {
    let is_test =
        |path: &Path| path.to_string_lossy().ends_with("tests.rs") || path.ends_with("testing.rs");
    let crates = std::fs::read_dir(root)
        .expect("the workspace")
        .flatten()
        .map(|entry| entry.path().join("src"));
    let mut folders: Vec<PathBuf> = crates
        .chain(
            ["src", "calibration/procedures/src", "session/report/src"].map(|src| root.join(src)),
        )
        .filter(|folder| folder.is_dir())
        .collect();
    let mut files = Vec::new();
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(folder)
            .expect("a folder of sources")
            .flatten()
            .map(|entry| entry.path())
        {
            match path.is_dir() {
                true => folders.push(path),
                false
                    if path.extension().is_some_and(|extension| extension == "rs")
                        && !is_test(&path) =>
                {
                    files.push(path);
                }
                false => {}
            }
        }
    }
    files.sort();
    files
}

#[test]
fn messages_name_only_flags_of_their_command() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (mut n_flags, mut wrong) = (0, Vec::new());
    for path in source_files(root) {
        let file = path
            .strip_prefix(root)
            .expect("in the workspace")
            .to_string_lossy()
            .into_owned();
        let source = std::fs::read_to_string(&path).expect("a source file");
        let mut texts = Texts::default();
        texts.visit_file(
            &syn::parse_file(&source).unwrap_or_else(|error| panic!("{file}: {error}")),
        );
        let texts: Vec<&String> = texts
            .0
            .iter()
            .filter(|text| !flags_in(text).is_empty())
            .collect();
        if texts.is_empty() {
            continue;
        }
        let accepted = accepted_in(&file);
        for text in texts {
            for flag in flags_in(text) {
                n_flags += 1;
                let is_accepted = accepted.iter().all(|flags| flags.contains(flag.name))
                    || NOT_PRINTED.contains(&(&*file, flag.name))
                    || names_a_command_with(text, flag);
                if !is_accepted {
                    wrong.push(format!("{file}: --{} in {text:?}", flag.name));
                }
            }
        }
    }
    assert_eq!(
        wrong,
        Vec::<String>::new(),
        "name the command that has the flag, or correct PRINTED_BY"
    );
    assert!(n_flags > 100, "{n_flags} flags were found");
}

#[test]
fn flags_are_found_in_texts() {
    let names = |text| {
        flags_in(text)
            .iter()
            .map(|flag| flag.name)
            .collect::<Vec<_>>()
    };
    assert_eq!(
        names("--out {}: give --max-splats, or (--scale)"),
        ["out", "max-splats", "scale"]
    );
    assert_eq!(
        names("a -- b, --{name}, x--y, var(--text), style=\"--part:1\", ---"),
        Vec::<&str>::new()
    );
    let is_accepted = |text: &str| names_a_command_with(text, flags_in(text)[0]);
    assert!(is_accepted("`fieldrig run --sim` replaces devices"));
    assert!(is_accepted("--max-bytes of `train`") && is_accepted("train --resume continues"));
    assert!(is_accepted("build it with `cargo build --release`"));
    assert!(!is_accepted("lower --max-splats") && !is_accepted("`fieldrig render --max-splats`"));
    let mut texts = Texts::default();
    let source = "#[doc = \"no\"] #[error(\"a {}\", 1)] enum E {} fn f() { bail!(#[doc = \"no\"] \"b\"); g(\"c\"); }";
    texts.visit_file(&syn::parse_str(source).expect("Rust"));
    assert_eq!(texts.0, ["a {}", "b", "c"]);
    assert_eq!(accepted_in("src/commands/move_arm.rs"), [flags_of("move")]);
    assert_eq!(
        accepted_in("capture/src/open/mod.rs"),
        [BTreeSet::<String>::new()]
    );
}
