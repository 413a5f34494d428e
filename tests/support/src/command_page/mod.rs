//! Renders a reference page in Markdown from a parser of command lines, so that the page lists
//! exactly the flags that the program accepts. Hand-written parts contain what help texts are too
//! short for.

mod table;

use clap::{Arg, Command};
use std::fmt::Write;
use table::{Row, as_code};

/// Maximum length of a line of prose, in characters.
const LINE_CHARS: usize = 120;

/// Flags that several commands share. They are listed once, and the commands refer to them.
#[derive(Clone, Copy, Debug)]
pub struct SharedFlags {
    /// Id of the group, which is the name of the struct with the flags.
    pub group: &'static str,
    /// Heading, from which the anchor of the section follows.
    pub title: &'static str,
}

impl SharedFlags {
    /// Whether a command accepts the flags.
    pub fn is_in(&self, command: &Command) -> bool {
        command
            .get_groups()
            .any(|group| group.get_id().as_str() == self.group)
    }

    /// Whether an argument of a command belongs to the group.
    pub fn contains(&self, command: &Command, argument: &Arg) -> bool {
        command
            .get_groups()
            .filter(|group| group.get_id().as_str() == self.group)
            .any(|group| group.get_args().any(|member| member == argument.get_id()))
    }

    fn link(&self) -> String {
        format!("[{}](#{})", lower_first(self.title), anchor(self.title))
    }
}

/// A command with its full name, such as `calibrate scene`.
#[derive(Clone, Debug)]
pub struct NamedCommand {
    /// The names of the command and of its parents, without the program.
    pub path: String,
    /// The parser.
    pub command: Command,
}

impl NamedCommand {
    /// Name of the hand-written part about this command, such as `calibrate-scene`.
    pub fn part(&self) -> String {
        self.path.replace(' ', "-")
    }

    fn link(&self) -> String {
        format!("[`{}`](#{})", self.path, anchor(&self.path))
    }
}

/// What a page is rendered from.
#[derive(Clone, Copy)]
pub struct CommandPage<'a> {
    /// The parser of the whole program.
    pub program: &'a Command,
    /// The groups of flags that are listed once.
    pub shared: &'a [SharedFlags],
    /// Returns a hand-written part: `head`, `shared` and `end`, and notes about commands and groups
    /// of flags, by [`NamedCommand::part`] and [`anchor`].
    pub part: &'a dyn Fn(&str) -> Option<String>,
}

impl CommandPage<'_> {
    /// The whole page.
    pub fn render(&self) -> String {
        let commands = commands(self.program);
        let mut page = (self.part)("head").unwrap_or_default();
        page += "\n| command | purpose |\n|---|---|\n";
        for named in &commands {
            let _ = writeln!(page, "| {} | {} |", named.link(), purpose(&named.command));
        }
        page += &self.section_of_shared_flags(&commands);
        for named in &commands {
            page += &self.section_of_command(named);
        }
        page + &self.notes("end")
    }
    fn section_of_shared_flags(&self, commands: &[NamedCommand]) -> String {
        let mut text = String::from("\n## Shared flags\n");
        text += &self.notes("shared");
        for shared in self.shared {
            let users: Vec<_> = commands
                .iter()
                .filter(|named| shared.is_in(&named.command))
                .collect();
            let Some(first) = users.first() else { continue };
            let links: Vec<String> = users.iter().map(|named| named.link()).collect();
            let _ = write!(text, "\n### {}\n\n", shared.title);
            text += &wrapped(&format!("Accepted by {}.", list(&links, "and")));
            text += "\n";
            let members = first
                .command
                .get_arguments()
                .filter(|argument| shared.contains(&first.command, argument));
            text += &table::of(members.map(|argument| Row::new(&first.command, argument)));
            text += &self.notes(&anchor(shared.title));
        }
        text
    }

    fn section_of_command(&self, named: &NamedCommand) -> String {
        let NamedCommand { path, command } = named;
        let level = "#".repeat(2 + path.matches(' ').count());
        let mut text = format!("\n{level} `{path}`\n\n");
        let about = command.get_long_about().or(command.get_about());
        text += &paragraphs(&about.map(ToString::to_string).unwrap_or_default());
        // Such a command does nothing without one of its subcommands, which have their own sections.
        if command.is_subcommand_required_set() {
            return text + &self.notes(&named.part());
        }
        let _ = write!(
            text,
            "\n```\n{}\n```\n",
            usage(self.program.get_name(), named)
        );
        let own: Vec<_> = command
            .get_arguments()
            .filter(|argument| !argument.is_hide_set() && !argument.is_global_set())
            .filter(|argument| {
                !self
                    .shared
                    .iter()
                    .any(|shared| shared.contains(command, argument))
            })
            .collect();
        if !own.is_empty() {
            text += "\n";
            text += &table::of(own.into_iter().map(|argument| Row::new(command, argument)));
        }
        let links: Vec<String> = self
            .shared
            .iter()
            .filter(|shared| shared.is_in(command))
            .map(SharedFlags::link)
            .collect();
        if !links.is_empty() {
            text += "\n";
            text += &wrapped(&format!(
                "`{path}` also accepts the {}.",
                list(&links, "and the")
            ));
        }
        let after = command
            .get_after_long_help()
            .or(command.get_after_help())
            .map(ToString::to_string);
        if let Some(after) = after {
            text += "\n";
            text += &paragraphs(&after);
        }
        text + &self.notes(&named.part())
    }

    /// A hand-written part, after an empty line. Empty if there is none.
    fn notes(&self, name: &str) -> String {
        (self.part)(name).map_or_else(String::new, |text| format!("\n{text}"))
    }
}

/// All commands of a program in the order of its help text, each followed by its subcommands.
pub fn commands(program: &Command) -> Vec<NamedCommand> {
    let mut named = Vec::new();
    for command in program.get_subcommands() {
        named.push(NamedCommand {
            path: command.get_name().to_owned(),
            command: command.clone(),
        });
        named.extend(command.get_subcommands().map(|sub| NamedCommand {
            path: format!("{} {}", command.get_name(), sub.get_name()),
            command: sub.clone(),
        }));
    }
    named.retain(|named| !named.command.is_hide_set());
    named
}

/// One sentence about a command.
fn purpose(command: &Command) -> String {
    let about = command.get_about().map(ToString::to_string);
    table::sentence(&about.unwrap_or_default())
}

/// How to call a command: its required flags and its arguments.
fn usage(program: &str, NamedCommand { path, command }: &NamedCommand) -> String {
    let mut usage = format!("{program} {path}");
    let is_optional = |argument: &&Arg| !argument.is_positional() && !argument.is_hide_set();
    if command
        .get_arguments()
        .any(|argument| is_optional(&argument))
    {
        usage += " [FLAGS]";
    }
    for argument in command.get_arguments().filter(|argument| {
        argument.is_required_set() && !argument.is_positional() && !argument.is_hide_set()
    }) {
        let _ = write!(usage, " {}", table::spelled(argument));
    }
    for argument in command.get_positionals() {
        let name = table::value_names(argument);
        let dashes = if argument.is_last_set() { "-- " } else { "" };
        let dots = match argument.get_num_args() {
            Some(range) if range.max_values() > 1 && dashes.is_empty() => "...",
            _ => "",
        };
        if argument.is_required_set() {
            let _ = write!(usage, " {name}{dots}");
        } else {
            let _ = write!(usage, " [{dashes}{name}{dots}]");
        }
    }
    usage
}

/// Words in one phrase, with a conjunction before the last.
fn list(words: &[String], conjunction: &str) -> String {
    match words.split_last() {
        Some((last, others)) if !others.is_empty() => {
            format!("{} {conjunction} {last}", others.join(", "))
        }
        _ => words.concat(),
    }
}

/// Help text of several paragraphs. Indented lines are shown as they are written.
fn paragraphs(text: &str) -> String {
    let paragraphs = text.split("\n\n").map(|paragraph| {
        if paragraph.lines().any(|line| line.starts_with("  ")) {
            format!("```\n{}\n```\n", paragraph.trim_end())
        } else {
            wrapped(&as_code(&table::sentence(paragraph)))
        }
    });
    paragraphs.collect::<Vec<_>>().join("\n")
}

/// The anchor of a heading, as on GitHub.
pub fn anchor(title: &str) -> String {
    title.to_lowercase().replace(' ', "-")
}

fn lower_first(text: &str) -> String {
    let mut chars = text.chars();
    chars.next().map_or_else(String::new, |first| {
        first.to_lowercase().chain(chars).collect()
    })
}

/// A paragraph in lines of limited length.
fn wrapped(text: &str) -> String {
    let mut lines = String::new();
    let mut line_chars = 0;
    for word in text.split_whitespace() {
        let n_chars = word.chars().count();
        if line_chars > 0 && line_chars + 1 + n_chars > LINE_CHARS {
            lines.push('\n');
            line_chars = 0;
        } else if line_chars > 0 {
            lines.push(' ');
            line_chars += 1;
        }
        lines += word;
        line_chars += n_chars;
    }
    lines + "\n"
}

#[cfg(test)]
mod tests;
