//! Tests that outputs into read-only folders are refused before any work, in one sentence.

use crate::command::stderr;
use crate::small_rig::{self, Pace};
use std::fs::{self, Permissions};
use std::io::ErrorKind;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Output};

/// A user without rights, whom every Linux has.
const NOBODY: u32 = 65_534;

/// Runs the program as a user who may not write everywhere, as root may. `None` if this user cannot
/// start the program.
fn as_user(folder: &Path, args: &[&str]) -> Option<Output> {
    let is_root = fs::metadata("/proc/self").expect("Linux").uid() == 0;
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command.args(args).current_dir(folder);
    if is_root {
        command.uid(NOBODY).gid(NOBODY);
    }
    match command.output() {
        Err(error) if is_root && error.kind() == ErrorKind::PermissionDenied => None,
        output => Some(output.expect("fieldrig starts")),
    }
}

fn set_mode(folder: &Path, mode: u32) {
    fs::set_permissions(folder, Permissions::from_mode(mode)).expect("our folder");
}

#[test]
fn read_only_folders_are_refused_before_devices_are_opened() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    small_rig::write(folder, Pace::Lockstep);
    set_mode(folder, 0o555);
    let commands: [(&str, &str); 4] = [
        ("init new.toml --robot ur5e", "new.toml"),
        ("record rig.toml --seconds 1 --out scan.mcap", "scan.mcap"),
        ("run rig.toml --steps 1", "runs"),
        ("run rig.toml --steps 1 --out result", "result"),
    ];
    let outputs = commands.map(|(command, file)| {
        let words: Vec<&str> = command.split(' ').collect();
        (as_user(folder, &words), file)
    });
    set_mode(folder, 0o755);
    for (output, file) in outputs {
        let Some(output) = output else {
            eprintln!("skipped: the user nobody cannot start the program");
            return;
        };
        let printed = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "{printed}");
        let error = printed
            .lines()
            .find(|line| line.starts_with("error: "))
            .expect("an error");
        assert!(
            error.contains(file)
                && error.contains("this user may not write into the folder")
                && error.contains(&*folder.to_string_lossy()),
            "{printed}"
        );
        assert!(!printed.contains("opening the devices"), "{printed}");
        assert!(!printed.contains("searching for"), "{printed}");
    }
}
