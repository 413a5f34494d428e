//! The folder of a run, which somebody may remove or rename while the run continues.

use crate::run_folder;
use anyhow::Context;
use drivers::recording::{RIG_FILE, URDF_FILE};
use files::{Kept, Place};
use std::path::Path;
use std::time::{Duration, Instant};

/// Period of the checks. A check costs a few system calls. Files that are written between the
/// removal of the folder and the next check are lost, or go to the moved folder.
const PERIOD: Duration = Duration::from_secs(1);

/// The list of keyframes in the folder of a run.
const KEYFRAME_LIST: &str = "keyframes.txt";

/// A folder that is made again if it disappears.
#[derive(Debug)]
pub struct KeptFolder {
    /// `None` if the folder cannot be watched, or could not be created again.
    kept: Option<Kept>,
    /// Names and contents of the files that are written only at the start of a run.
    first_files: Vec<(&'static str, Vec<u8>)>,
    next_check: Instant,
}

impl KeptFolder {
    /// Watches the folder of a model, and with `in_subfolder` also its parent, the folder of the
    /// run.
    pub fn of_run(folder: &Path, in_subfolder: bool) -> Vec<Self> {
        folder
            .ancestors()
            .take(if in_subfolder { 2 } else { 1 })
            .map(Self::new)
            .collect()
    }

    /// Watches a locked folder, after the first files were written into it.
    fn new(folder: &Path) -> Self {
        Self {
            kept: Kept::open(folder).ok(),
            // A run folder may lack some of these files.
            first_files: [RIG_FILE, URDF_FILE, KEYFRAME_LIST]
                .into_iter()
                .filter_map(|name| Some((name, text_file(folder, name)?)))
                .collect(),
            next_check: Instant::now() + PERIOD,
        }
    }

    /// Checks the folder if it is due.
    pub fn check_when_due(&mut self) {
        if Instant::now() >= self.next_check {
            self.check();
            self.next_check = Instant::now() + PERIOD;
        }
    }

    /// Creates the folder again if it was removed or renamed. Later writes go to the new folder.
    pub fn check(&mut self) {
        let Some(kept) = &self.kept else { return };
        let path = kept.path().to_owned();
        let what = match kept.place() {
            Place::Here => return,
            Place::MovedTo(to) => format!("was moved to {}", to.display()),
            Place::Removed => "was removed".to_owned(),
        };
        let shown = path.display();
        self.kept = match self.make_again(&path) {
            Ok(kept) => {
                log::warn!(
                    "the run folder {shown} {what}: the run continues in a new folder {shown}"
                );
                Some(kept)
            }
            Err(error) => {
                log::warn!(
                    "the run folder {shown} {what}, and no new one can be created: {error:#}"
                );
                None
            }
        };
    }

    fn make_again(&self, path: &Path) -> anyhow::Result<Kept> {
        let in_folder = || format!("cannot write {}", path.display());
        std::fs::create_dir_all(path).with_context(in_folder)?;
        // The lock was in the old folder. Without a lock, another run could use the new folder.
        run_folder::lock(path)?;
        for (name, contents) in &self.first_files {
            files::write(&path.join(name), contents).with_context(in_folder)?;
        }
        Kept::open(path).with_context(in_folder)
    }
}

/// Contents of a file of a folder; `None` if it cannot be read.
fn text_file(folder: &Path, name: &str) -> Option<Vec<u8>> {
    files::read(&folder.join(name), files::Budget::TEXT).ok()
}

#[cfg(test)]
mod tests {
    use super::KeptFolder;
    use drivers::recording::{RIG_FILE, URDF_FILE};
    use std::fs;

    #[test]
    fn folder_is_made_again_with_its_first_files() {
        let parent = tempfile::tempdir().expect("a folder");
        let run = parent.path().join("run");
        fs::create_dir(&run).expect("space");
        fs::write(run.join(RIG_FILE), "a rig").expect("space");
        fs::write(run.join(URDF_FILE), "<robot/>").expect("space");
        let mut kept = KeptFolder::new(&run);
        kept.check();
        fs::write(run.join("report.json"), "{}").expect("space");
        for n in 0..2 {
            match n {
                0 => fs::remove_dir_all(&run).expect("it is there"),
                _ => fs::rename(&run, parent.path().join("renamed")).expect("it is there"),
            }
            kept.check();
            assert_eq!(
                fs::read_to_string(run.join(RIG_FILE)).expect("written again"),
                "a rig"
            );
            assert_eq!(
                fs::read_to_string(run.join(URDF_FILE)).expect("written again"),
                "<robot/>"
            );
            assert!(run.join(".lock").exists() && !run.join("report.json").exists());
        }
        fs::remove_dir_all(&run).expect("it is there");
        fs::write(&run, "a file").expect("space");
        kept.check();
        kept.check();
        assert_eq!(fs::read_to_string(&run).expect("it stays"), "a file");
    }
}
