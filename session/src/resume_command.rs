//! The command that continues a run. It works as printed in the folder where the run was started.

use crate::next_commands::{argument, command_line};
use messages::Setting;
use std::collections::BTreeMap;
use std::path::Path;

/// Names of the flags in checkpoints of runs on recordings: the file, whether it is played in real
/// time, and whether it is played again whenever it ends.
pub(crate) const FROM: &str = "from";
pub(crate) const REAL_TIME: &str = "real-time";
pub(crate) const REPEAT: &str = "repeat";

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

    /// Continues a run on a recording.
    ///
    /// * `rig_file`: replaces the one in the recording, as it did in the run.
    pub fn of_recording(recording: &Path, rig_file: Option<&Path>) -> Self {
        let mut command = Self::of_data(recording);
        let rig = rig_file.map(|file| [Setting::Rig.to_string(), file.display().to_string()]);
        command.words.extend(rig.into_iter().flatten());
        command
    }

    /// Continues a run on a recording that is played in real time, from the beginning of the
    /// recording.
    ///
    /// * `rig_file`: replaces the one in the recording, as it did in the run.
    /// * `is_repeated`: whether the recording is played again whenever it ends.
    pub fn of_playback(recording: &Path, rig_file: Option<&Path>, is_repeated: bool) -> Self {
        let mut words = vec!["run".to_owned()];
        words.extend(rig_file.map(argument));
        words.extend([
            Setting::From.to_string(),
            recording.display().to_string(),
            Setting::RealTime.to_string(),
        ]);
        words.extend(is_repeated.then(|| Setting::Repeat.to_string()));
        Self { words }
    }

    /// Continues a live run with its rig file and the flags in its checkpoint.
    pub(crate) fn of_live_run(flags: &BTreeMap<String, String>, rig_file: &Path) -> Self {
        match flags.get(FROM).map(Path::new) {
            Some(recording) if flags.contains_key(REAL_TIME) => {
                let is_repeated = flags.contains_key(REPEAT);
                Self::of_playback(recording, Some(rig_file), is_repeated)
            }
            Some(recording) => Self::of_recording(recording, Some(rig_file)),
            None => Self::of_devices(rig_file),
        }
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
        let rig_file = Some(Path::new("rig.toml"));
        let recorded = ResumeCommand::of_recording(Path::new("a.mcap"), rig_file);
        assert_eq!(
            words(&recorded.line(Path::new("out"))),
            ["train", "a.mcap", "rig", "rig.toml", "resume", "out"]
        );
        let stored = ResumeCommand::of_recording(Path::new("a.mcap"), None);
        assert_eq!(
            words(&stored.line(Path::new("out"))),
            ["train", "a.mcap", "resume", "out"]
        );
    }

    #[test]
    fn a_recording_played_in_real_time_is_played_again() {
        let recording = Path::new("my scan.mcap");
        let rig_file = Some(Path::new("rig.toml"));
        for (rig_file, is_repeated, expected) in [
            (
                rig_file,
                false,
                "run|rig.toml|recording|my scan.mcap|real_time",
            ),
            (
                rig_file,
                true,
                "run|rig.toml|recording|my scan.mcap|real_time|repeat",
            ),
            (None, false, "run|recording|my scan.mcap|real_time"),
        ] {
            let command = ResumeCommand::of_playback(recording, rig_file, is_repeated);
            let line = command.line(Path::new("out"));
            assert_eq!(words(&line).join("|"), format!("{expected}|resume|out"));
        }
    }

    #[test]
    fn the_flags_of_a_live_run_name_its_input() {
        let rig_file = Path::new("out/rig.toml");
        for (given, expected) in [
            (&[][..], "run|out/rig.toml"),
            (&[FROM], "train|a.mcap|rig|out/rig.toml"),
            (
                &[FROM, REAL_TIME],
                "run|out/rig.toml|recording|a.mcap|real_time",
            ),
            (
                &[FROM, REAL_TIME, REPEAT],
                "run|out/rig.toml|recording|a.mcap|real_time|repeat",
            ),
        ] {
            let value = |name: &str| if name == FROM { "a.mcap" } else { "true" };
            let flags = given
                .iter()
                .map(|name| ((*name).to_owned(), value(name).to_owned()))
                .collect();
            let line = ResumeCommand::of_live_run(&flags, rig_file).line(Path::new("out"));
            assert_eq!(words(&line).join("|"), format!("{expected}|resume|out"));
        }
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
