//! Checks that messages name only flags of the command that prints them, and that libraries name
//! settings instead of flags.

use crate::cli::Cli;
use crate::flag_names::flag;
use clap::CommandFactory;
use messages::Setting;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use syn::buffer::{Cursor, TokenBuffer};
use syn::visit::Visit;
use syn::{Attribute, Item, LitStr, Macro, Meta};

/// Source files or folders, and the commands that print their messages. If a message contains a
/// flag or setting, all these commands must accept it. The exception is a message that names a
/// command that accepts the flag.
const PRINTED_BY: [(&str, &[&str]); 45] = [
    ("bench/src", &["bench"]),
    (
        "calibration/procedures/src/hand_eye",
        &["calibrate hand-eye"],
    ),
    (
        "calibration/procedures/src/images.rs",
        &["calibrate intrinsics", "calibrate hand-eye"],
    ),
    (
        "calibration/procedures/src/intrinsics.rs",
        &["calibrate intrinsics"],
    ),
    (
        "calibration/procedures/src/outputs.rs",
        &["calibrate intrinsics", "calibrate hand-eye"],
    ),
    (
        "calibration/procedures/src/printed_target.rs",
        &["calibrate target"],
    ),
    (
        "calibration/procedures/src/saved_images.rs",
        &["calibrate intrinsics"],
    ),
    (
        "calibration/procedures/src/scan.rs",
        &["calibrate intrinsics", "calibrate hand-eye"],
    ),
    ("calibration/procedures/src/scene.rs", &["calibrate scene"]),
    ("calibration/src/hand_eye", &["calibrate hand-eye"]),
    ("capture/src/init", &["init"]),
    ("capture/src/open/steered.rs", &["run"]),
    ("capture/src/open/steered_base.rs", &["run"]),
    ("capture/src/record.rs", &["record"]),
    ("capture/src/requested_motion.rs", &["move"]),
    ("capture/src/rig_facts", &["doctor"]),
    ("keyframe/src/error.rs", &["train", "eval", "bench"]),
    ("session/src/camera_path.rs", &["render"]),
    ("session/src/checkpoints.rs", &["run", "train"]),
    (
        "session/src/corrected_rig.rs",
        &["calibrate intrinsics", "calibrate hand-eye"],
    ),
    ("session/src/data.rs", &["train", "eval", "bench"]),
    ("session/src/depth_from.rs", &["train"]),
    ("session/src/eval_plan.rs", &["eval"]),
    ("session/src/likely_cause.rs", &["run", "train"]),
    ("session/src/method_options.rs", &["run", "train", "bench"]),
    ("session/src/event_texts.rs", &["run", "train"]),
    ("session/src/export_plan.rs", &["export"]),
    ("session/src/render_plan.rs", &["render"]),
    ("session/src/rendered_files.rs", &["render"]),
    ("session/src/resume_command.rs", &["run", "train"]),
    ("session/src/run_folder.rs", &["run", "train"]),
    ("session/src/run_plan", &["run"]),
    ("session/src/scene_calibration.rs", &["calibrate scene"]),
    ("session/src/session/persistence.rs", &["run", "train"]),
    ("session/src/train_plan", &["train"]),
    ("session/src/training.rs", &["train", "bench"]),
    (
        "session/src/training_options.rs",
        &["run", "train", "bench"],
    ),
    (
        "src/app_window.rs",
        &[
            "run",
            "view",
            "preview",
            "calibrate intrinsics",
            "calibrate hand-eye",
        ],
    ),
    ("src/commands/bench", &["bench"]),
    ("src/commands/calibrate", &["calibrate"]),
    (
        "src/page_args.rs",
        &[
            "run",
            "view",
            "preview",
            "calibrate intrinsics",
            "calibrate hand-eye",
        ],
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
        &[
            "run",
            "view",
            "preview",
            "calibrate intrinsics",
            "calibrate hand-eye",
        ],
    ),
    // This builds command lines for another command.
    ("src/commands/bench/run_flags.rs", &["run"]),
];

/// Settings in messages of libraries, where the message names a command that accepts the setting.
const NAMED_WITH_COMMAND: [(&str, Setting, &str); 28] = [
    (
        "capture/src/calibration_commands.rs",
        Setting::Camera,
        "calibrate",
    ),
    (
        "capture/src/calibration_commands.rs",
        Setting::Out,
        "calibrate",
    ),
    (
        "capture/src/calibration_commands.rs",
        Setting::Target,
        "calibrate",
    ),
    (
        "capture/src/calibration_commands.rs",
        Setting::WriteRig,
        "calibrate",
    ),
    ("capture/src/dataset.rs", Setting::Scale, "train"),
    ("capture/src/doctor/mod.rs", Setting::Sim, "run"),
    ("capture/src/emulation/mod.rs", Setting::Sim, "run"),
    ("capture/src/found_devices.rs", Setting::Sim, "run"),
    ("capture/src/init/plan.rs", Setting::Sim, "run"),
    ("capture/src/init/rig_text.rs", Setting::Sim, "run"),
    (
        "capture/src/init/rig_text.rs",
        Setting::WriteRig,
        "calibrate",
    ),
    ("capture/src/open/mod.rs", Setting::Rig, "train"),
    ("capture/src/open/mod.rs", Setting::Sim, "run"),
    (
        "capture/src/supervised_arm.rs",
        Setting::EnableMotion,
        "move",
    ),
    ("capture/src/supervised_arm.rs", Setting::Recover, "move"),
    ("session/src/next_commands.rs", Setting::Keyframes, "eval"),
    ("session/src/next_commands.rs", Setting::Out, "export"),
    ("session/src/next_commands.rs", Setting::To, "export"),
    ("session/src/page_check.rs", Setting::Listen, "run"),
    ("session/src/resume_command.rs", Setting::From, "run"),
    ("session/src/resume_command.rs", Setting::RealTime, "run"),
    ("session/src/resume_command.rs", Setting::Repeat, "run"),
    ("session/src/resume_command.rs", Setting::Rig, "train"),
    ("session/src/saved_view.rs", Setting::From, "run"),
    (
        "session/src/steering/steering_log/place.rs",
        Setting::EnableMotion,
        "run",
    ),
    ("session/src/training.rs", Setting::DepthFrom, "train"),
    ("trainer/gpu/src/error.rs", Setting::MaxBytes, "train"),
    ("trainer/gpu/src/error.rs", Setting::MaxSplats, "train"),
];

/// Long flags of a command such as `train` or `bench curve`, and of its subcommands.
pub(crate) fn flags_of(path: &str) -> BTreeSet<String> {
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
    // If several paths match, the longest path is the most specific.
    let places = PRINTED_BY.iter().filter(|(place, _)| is_in(file, place));
    if let Some((_, commands)) = places.max_by_key(|(place, _)| place.len()) {
        return commands.iter().map(|command| flags_of(command)).collect();
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
pub(crate) struct NamedFlag<'a> {
    pub(crate) name: &'a str,
    before: &'a str,
}

/// The flags that a text names, such as `--seconds`.
pub(crate) fn flags_in(text: &str) -> Vec<NamedFlag<'_>> {
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
pub(crate) fn names_a_command_with(text: &str, flag: NamedFlag<'_>) -> bool {
    let is_named = |name: &str| {
        text.contains(&format!("fieldrig {name}"))
            || text.contains(&format!("`{name}`"))
            || flag.before.ends_with(&format!("{name} "))
    };
    let cli = Cli::command();
    let mut commands = cli.get_subcommands().map(|command| command.get_name());
    is_of_other_program(text, flag)
        || commands.any(|name| is_named(name) && flags_of(name).contains(flag.name))
}

/// Whether a flag belongs to another program that the text names: to cargo, or to a sender.
fn is_of_other_program(text: &str, flag: NamedFlag<'_>) -> bool {
    match flag.name {
        "features" | "release" => text.contains("build"),
        "to" => text.contains("scripts/senders/"),
        _ => false,
    }
}

/// The settings that a source file names.
fn settings_in(source: &str) -> Vec<Setting> {
    let after = source.split("Setting::").skip(1);
    let names = after.map(|rest| rest.split(|c: char| !c.is_alphanumeric()).next());
    let all = Setting::ALL.iter().copied();
    names
        .filter_map(|name| {
            all.clone()
                .find(|setting| Some(&*format!("{setting:?}")) == name)
        })
        .collect()
}

/// Whether a source file names a command that accepts a flag, as `fieldrig train` or as a word.
fn names_command_with(source: &str, command: &str, flag: &str) -> bool {
    let is_named = [format!("fieldrig {command}"), format!("\"{command}\"")]
        .iter()
        .any(|text| source.contains(text));
    is_named && flags_of(command).contains(flag)
}

/// The texts of a source file, without those of tests, documentation and help.
fn texts_of(file: &str, source: &str) -> Vec<String> {
    let mut texts = Texts::default();
    texts.visit_file(&syn::parse_file(source).unwrap_or_else(|error| panic!("{file}: {error}")));
    texts.0
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

    /// Of attributes, only the messages of errors are read.
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

/// The workspace.
fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Source files of all libraries, except tests.
fn library_files() -> Vec<(String, String)> {
    let manifest = std::fs::read_to_string(root().join("Cargo.toml")).expect("a manifest");
    let manifest: toml::Table = manifest.parse().expect("TOML");
    let members = manifest["workspace"]["members"].as_array().expect("crates");
    let names = members
        .iter()
        .map(|member| member.as_str().expect("a path"));
    let libraries = names.filter(|name| !name.starts_with("tests/"));
    source_files(
        libraries
            .map(|name| root().join(name).join("src"))
            .collect(),
    )
}

/// Source files in folders, except tests: their paths in the workspace and their contents.
fn source_files(mut folders: Vec<PathBuf>) -> Vec<(String, String)> {
    let is_test =
        |path: &Path| path.to_string_lossy().ends_with("tests.rs") || path.ends_with("testing.rs");
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
    files.into_iter().map(read).collect()
}

/// The path of a source file in the workspace, and its contents.
fn read(path: PathBuf) -> (String, String) {
    let file = path.strip_prefix(root()).expect("in the workspace");
    let source = std::fs::read_to_string(&path).expect("a source file");
    (file.to_string_lossy().into_owned(), source)
}

#[test]
fn messages_name_only_flags_of_their_command() {
    let (mut n_flags, mut wrong) = (0, Vec::new());
    // Flags of settings are not checked here, but in the libraries, which name the settings.
    let files = source_files(vec![root().join("src")]);
    for (file, source) in files.iter().filter(|(file, _)| file != "src/flag_names.rs") {
        let texts = texts_of(file, source);
        let texts: Vec<&String> = texts
            .iter()
            .filter(|text| !flags_in(text).is_empty())
            .collect();
        if texts.is_empty() {
            continue;
        }
        let accepted = accepted_in(file);
        for text in texts {
            for flag in flags_in(text) {
                n_flags += 1;
                let is_accepted = accepted.iter().all(|flags| flags.contains(flag.name))
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
    assert!(n_flags > 20, "{n_flags} flags were found");
}

#[test]
fn libraries_name_settings_instead_of_flags() {
    let files = library_files();
    assert!(files.len() > 200, "{} files", files.len());
    let mut named = Vec::new();
    for (file, source) in &files {
        for text in texts_of(file, source) {
            let flags = flags_in(&text).into_iter();
            let own = flags.filter(|flag| !is_of_other_program(&text, *flag));
            named.extend(own.map(|flag| format!("{file}: --{} in {text:?}", flag.name)));
        }
    }
    assert_eq!(named, Vec::<String>::new(), "name a `messages::Setting`");
}

#[test]
fn libraries_name_only_settings_of_the_command_that_prints_them() {
    let (mut n_settings, mut wrong) = (0, Vec::new());
    let mut unused = NAMED_WITH_COMMAND.to_vec();
    for (file, source) in library_files() {
        let settings = settings_in(&source);
        // The crate `messages` defines the settings, so it names them without printing them.
        if settings.is_empty() || is_in(&file, "keyframe/messages") {
            continue;
        }
        let accepted = accepted_in(&file);
        for setting in settings {
            n_settings += 1;
            let name = flag(setting).trim_start_matches("--");
            let is_here =
                |(place, other, _): &(&str, Setting, &str)| *place == file && *other == setting;
            let is_named = NAMED_WITH_COMMAND
                .iter()
                .filter(|named| is_here(named))
                .any(|(_, _, command)| names_command_with(&source, command, name));
            unused.retain(|named| !is_here(named));
            if !is_named && !accepted.iter().all(|flags| flags.contains(name)) {
                wrong.push(format!("{file}: {setting:?}"));
            }
        }
    }
    assert_eq!(
        wrong,
        Vec::<String>::new(),
        "name the command that has the flag, or correct PRINTED_BY or NAMED_WITH_COMMAND"
    );
    assert!(unused.is_empty(), "no message names {unused:?}");
    assert!(n_settings > 60, "{n_settings} settings were found");
}

#[test]
fn every_setting_is_a_flag() {
    let cli = Cli::command();
    let commands = cli.get_subcommands().map(|command| command.get_name());
    let flags: BTreeSet<String> = commands.flat_map(flags_of).collect();
    for setting in Setting::ALL {
        let name = flag(*setting).strip_prefix("--").expect("two hyphens");
        assert!(flags.contains(name), "{setting:?}: no command has --{name}");
    }
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
