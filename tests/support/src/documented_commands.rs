//! The commands in the code blocks of README and guides.

use std::path::{Path, PathBuf};

/// A command of `fieldrig` in a code block of a page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DocumentedCommand {
    /// Name of the page, such as `quickstart.md`.
    pub page: String,
    /// The words after `fieldrig`.
    pub words: Vec<String>,
}

/// The commands of `README.md` and `docs/guide/*.md`, page by page.
///
/// # Panics
///
/// If a page cannot be read.
pub fn documented_commands(repository: &Path) -> Vec<DocumentedCommand> {
    let guides = std::fs::read_dir(repository.join("docs/guide")).expect("there are guides");
    let mut paths: Vec<PathBuf> = guides
        .map(|entry| entry.expect("the folder can be read").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "md"))
        .collect();
    paths.push(repository.join("README.md"));
    paths.sort();
    let of_page = |path: &PathBuf| {
        let page = path.file_name().unwrap_or_default().to_string_lossy();
        let text = std::fs::read_to_string(path).expect("the page can be read");
        let named = |words| DocumentedCommand {
            page: page.clone().into_owned(),
            words,
        };
        commands_in(&text)
            .into_iter()
            .map(named)
            .collect::<Vec<_>>()
    };
    paths.iter().flat_map(of_page).collect()
}

/// The words after `fieldrig` of each command in the code blocks of a page. A backslash at the end
/// of a line continues the command, and a number sign begins a comment.
fn commands_in(page: &str) -> Vec<Vec<String>> {
    let mut commands = Vec::new();
    let mut is_code = false;
    let mut continued = String::new();
    for line in page.lines().map(str::trim) {
        if line.starts_with("```") {
            is_code = !is_code;
        } else if is_code {
            continued.push_str(line);
            if continued.ends_with('\\') {
                continued.pop();
                continue;
            }
            commands.extend(arguments(&std::mem::take(&mut continued)));
        }
    }
    commands
}

/// The words after `fieldrig`, if a line calls it.
fn arguments(line: &str) -> Option<Vec<String>> {
    let code = line.split(" #").next().unwrap_or_default();
    let rest = code.strip_prefix("fieldrig")?;
    if !rest.is_empty() && !rest.starts_with(' ') {
        return None;
    }
    Some(rest.split_whitespace().map(str::to_owned).collect())
}

#[cfg(test)]
mod tests {
    use super::commands_in;

    #[test]
    fn commands_are_found_in_code_blocks() {
        let page = "`fieldrig no`\nfieldrig no\n```\nmake demo\nfieldrig run a.toml --sim   # simulated\n\
                    fieldrig train \\\n    b.mcap\nfieldrigs no\n```\n  ```toml\n  fieldrig doctor\n  ```\n";
        let found: Vec<String> = commands_in(page)
            .iter()
            .map(|words| words.join(" "))
            .collect();
        assert_eq!(found, ["run a.toml --sim", "train b.mcap", "doctor"]);
    }
}
