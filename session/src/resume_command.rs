//! The command that continues a run. It works as printed in the folder where the run was started.

use crate::next_commands::{argument, command_line};
use messages::Setting;
use std::path::Path;

/// A command that continues runs, without the folder of the run. Flags of the run are not part of
/// it, because they are in the checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ResumeCommand {
    words: Vec<String>,
}

impl ResumeCommand {
    /// Continues with the devices of a rig file.
    pub fn of_devices(rig_file: &Path) -> Self {
        Self {
            words: vec!["run".to_owned(), argument(rig_file)],
        }
    }

    /// Continues with a dataset folder or a recording.
    pub fn of_data(data: &Path) -> Self {
        Self {
            words: vec!["train".to_owned(), argument(data)],
        }
    }

    /// Continues a run on a recording. The rig file replaces the one in the recording, as it did in
    /// the run.
    pub fn of_recording(recording: &Path, rig_file: &Path) -> Self {
        let mut command = Self::of_data(recording);
        command
            .words
            .extend([Setting::Rig.to_string(), rig_file.display().to_string()]);
        command
    }

    /// The command line that continues the run in a folder.
    pub fn line(&self, folder: &Path) -> String {
        let words = self.words.iter().cloned();
        let folder = [Setting::Resume.to_string(), folder.display().to_string()];
        command_line(words.chain(folder))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    /// The words of a command line as the shell passes them, without the program.
    fn words(line: &str) -> Vec<String> {
        let printed = Command::new("sh")
            .args(["-c", &format!("printf '%s\\n' {line}")])
            .output()
            .expect("sh starts");
        let printed = String::from_utf8(printed.stdout).expect("UTF-8");
        printed.lines().skip(1).map(str::to_owned).collect()
    }

    #[test]
    fn commands_are_complete_and_survive_the_shell() {
        let folder = Path::new("runs/it's $HOME");
        let line = ResumeCommand::of_devices(Path::new("my rig.toml")).line(folder);
        assert_eq!(
            words(&line),
            ["run", "my rig.toml", "resume", "runs/it's $HOME"]
        );
        let line = ResumeCommand::of_data(Path::new("-data")).line(folder);
        assert_eq!(
            words(&line),
            ["train", "./-data", "resume", "runs/it's $HOME"]
        );
        let recorded = ResumeCommand::of_recording(Path::new("a.mcap"), Path::new("rig.toml"));
        assert_eq!(
            words(&recorded.line(Path::new("out"))),
            ["train", "a.mcap", "rig", "rig.toml", "resume", "out"]
        );
    }

    #[test]
    fn the_program_is_named_as_it_was_called() {
        let line = ResumeCommand::of_data(Path::new("data")).line(Path::new("out"));
        let program = std::env::args().next().expect("a program");
        let printed = Command::new("sh")
            .args(["-c", &format!("printf '%s\\n' {line}")])
            .output()
            .expect("sh starts");
        let printed = String::from_utf8(printed.stdout).expect("UTF-8");
        assert_eq!(printed.lines().next(), Some(&*program));
    }
}
