//! What is printed if a second Ctrl-C ends the program before its results are saved.

use crate::print;
use parking_lot::Mutex;
use session::StartedRun;

/// The models of the run in progress.
static STARTED: Mutex<Vec<StartedRun>> = Mutex::new(Vec::new());

/// Remembers a model of the run in progress, and forgets those of an earlier run.
pub(crate) fn remember(run: &StartedRun) {
    let mut started = STARTED.lock();
    started.retain(|other| other.run_folder == run.run_folder);
    started.push(run.clone());
}

/// Prints what is left of the run, and waits briefly until it is printed.
pub(crate) fn print_left() {
    // The program must end even if another thread holds the lock.
    let started = STARTED
        .try_lock()
        .map_or_else(Vec::new, |started| started.clone());
    for line in lines(&started) {
        print::notice(line);
    }
    print::flush_briefly();
}

fn lines(started: &[StartedRun]) -> Vec<String> {
    if started.is_empty() {
        return vec!["exiting at once".to_owned()];
    }
    started
        .iter()
        .map(|run| format!("exiting at once: {}", run.describe_left()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_model_has_a_line() {
        assert_eq!(lines(&[]), ["exiting at once"]);
        let folder = tempfile::tempdir().expect("a folder");
        let run = |name: &str| StartedRun {
            run_folder: folder.path().to_owned(),
            model_folder: folder.path().join(name),
            resume_command: String::new(),
        };
        let lines = lines(&[run("tsdf"), run("splat")]);
        assert!(
            lines[0].contains("tsdf contains no checkpoint"),
            "{lines:?}"
        );
        assert!(
            lines[1].contains("splat contains no checkpoint"),
            "{lines:?}"
        );
    }
}
