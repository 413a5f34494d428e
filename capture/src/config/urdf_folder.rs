//! Where the mesh files of a robot description are.

use crate::mesh_files::{found_mesh_file, missing_mesh_file};
use crate::recorded_meshes::RecordedMeshes;
use files::Budget;
use std::path::{Path, PathBuf};

/// Folder of the robot description of a rig that was read from a file, and the mesh files of a
/// recording. Mesh files are named relative to the folder. Neither is part of the rig: two rigs
/// that differ only in this value are equal.
#[derive(Clone, Debug, Default)]
pub struct UrdfFolder {
    folder: Option<PathBuf>,
    recorded: Option<RecordedMeshes>,
}

impl UrdfFolder {
    /// The absolute folder of the file at `path`.
    pub(super) fn of(path: &Path) -> Self {
        let absolute = std::path::absolute(path).ok();
        let folder = absolute.and_then(|path| path.parent().map(Path::to_owned));
        Self {
            folder,
            recorded: None,
        }
    }

    /// A robot description in this folder. If the path is relative, the folder counts as unknown.
    #[must_use]
    pub fn at(folder: &Path) -> Self {
        Self {
            folder: folder.is_absolute().then(|| folder.to_owned()),
            recorded: None,
        }
    }

    /// Adds the mesh files of a recording. If there already are mesh files of a recording, these
    /// files are kept.
    #[must_use]
    pub(crate) fn with_recorded(self, recorded: RecordedMeshes) -> Self {
        Self {
            folder: self.folder,
            recorded: self.recorded.or(Some(recorded)),
        }
    }

    /// The folder; `None` if the rig was not read from a file.
    #[must_use]
    pub fn path(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    /// Contents of a mesh file, with at most `budget.max_bytes` bytes. If the rig comes from
    /// a recording, the mesh files of the recording come first. Otherwise, they only replace
    /// missing files.
    ///
    /// # Errors
    ///
    /// Why the file cannot be read, in one sentence.
    pub fn read_mesh(&self, file: &str, budget: Budget) -> Result<Vec<u8>, String> {
        let path = self.path().and_then(|folder| found_mesh_file(file, folder));
        let recorded = self.recorded.as_ref();
        let is_recorded = recorded.is_some_and(|recorded| recorded.contains(file));
        match (path, recorded) {
            (Some(path), _) if !is_recorded => read_file(&path, budget),
            (Some(path), Some(recorded)) if !recorded.come_first() => read_file(&path, budget),
            (_, Some(recorded)) if is_recorded => recorded.read(file, budget),
            (_, recorded) => Err(self.missing(file, recorded)),
        }
    }

    /// Why there is no such file.
    fn missing(&self, file: &str, recorded: Option<&RecordedMeshes>) -> String {
        let on_disk = self.path().map_or_else(
            || "the folder of the mesh files is unknown".to_owned(),
            |folder| missing_mesh_file(file, folder),
        );
        match recorded {
            None => on_disk,
            Some(recorded) => format!("{}, and {on_disk}", recorded.without()),
        }
    }
}

fn read_file(path: &Path, budget: Budget) -> Result<Vec<u8>, String> {
    let shown = path.display();
    files::read(path, budget).map_err(|error| match error.kind() {
        std::io::ErrorKind::FileTooLarge => format!("{shown}: {error}; reduce its triangles"),
        _ => format!("cannot read {shown}: {error}"),
    })
}

impl PartialEq for UrdfFolder {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "meshes/a.stl";

    fn contents(folder: &UrdfFolder) -> String {
        let read = folder.read_mesh(FILE, Budget::MESH);
        read.map_or_else(|why| why, |bytes| String::from_utf8(bytes).expect("a text"))
    }

    #[test]
    fn meshes_are_read_from_the_folder_and_from_the_recording() {
        let root = tempfile::tempdir().expect("a folder");
        std::fs::create_dir(root.path().join("meshes")).expect("a folder");
        std::fs::write(root.path().join(FILE), "disk").expect("written");
        let here = UrdfFolder::at(root.path());
        let elsewhere = UrdfFolder::at(Path::new("/nowhere"));
        let recorded = RecordedMeshes::of_files([(FILE, &b"recorded"[..])]);
        let first = recorded.clone().before_files();
        let none = RecordedMeshes::of_files([]);
        for (folder, recorded, expected) in [
            (&here, None, "disk"),
            (&here, Some(&recorded), "disk"),
            (&here, Some(&first), "recorded"),
            (&here, Some(&none), "disk"),
            (&elsewhere, Some(&recorded), "recorded"),
            (
                &elsewhere,
                None,
                "no such file; relative names start at /nowhere",
            ),
            (
                &elsewhere,
                Some(&none),
                "the recording contains no mesh files, like recordings of older versions, and no such file; relative names \
                 start at /nowhere",
            ),
            (
                &UrdfFolder::default(),
                None,
                "the folder of the mesh files is unknown",
            ),
        ] {
            let folder = match recorded {
                Some(recorded) => folder.clone().with_recorded(recorded.clone()),
                None => folder.clone(),
            };
            assert_eq!(contents(&folder), expected);
        }
        let other = RecordedMeshes::of_files([("b.stl", &b"b"[..])]);
        let lacking = elsewhere.with_recorded(other).with_recorded(recorded);
        assert_eq!(
            contents(&lacking),
            "the recording does not contain it, and no such file; relative names start at /nowhere",
            "the first recording counts"
        );
    }
}
