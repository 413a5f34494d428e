//! Finds the mesh files that a robot description names, and says which programs can read them.

use std::path::{Path, PathBuf};

/// Which parts of fieldrig can read a mesh file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshKind {
    /// Triangles (`.stl`, `.obj`, `.dae`): the page, the simulator, steering and masks of the robot.
    Triangles,
    /// None.
    Unsupported,
}

impl MeshKind {
    /// The kind of a file with this name.
    #[must_use]
    pub fn of(file: &str) -> Self {
        let extension = file.rsplit_once('.').map(|(_, extension)| extension);
        match extension.map(str::to_ascii_lowercase).as_deref() {
            Some("stl" | "obj" | "dae") => Self::Triangles,
            _ => Self::Unsupported,
        }
    }
}

/// The path of a mesh file; `None` if it does not exist.
pub(crate) fn found_mesh_file(file: &str, urdf_folder: &Path) -> Option<PathBuf> {
    mesh_file_candidates(file, urdf_folder)
        .into_iter()
        .find(|path| path.is_file())
}

/// Why a mesh file was not found. Most files are missing because only the URDF was copied.
pub(crate) fn missing_mesh_file(file: &str, urdf_folder: &Path) -> String {
    let folder = urdf_folder.display();
    let package = file
        .strip_prefix("package://")
        .and_then(|path| path.split_once('/'));
    match package {
        Some((package, rest)) => format!(
            "no file {rest:?} in a folder {package:?} beside or above {folder}; copy the whole package of the URDF"
        ),
        None => format!("no such file; relative names start at {folder}"),
    }
}

/// Paths where a mesh file may be, the most likely one first. The folder of a package is a parent
/// folder of the URDF, or beside such a parent. Usually, it has the name of the package. A parent
/// folder with another name may be the package, too: a checkout or a download is often renamed.
fn mesh_file_candidates(file: &str, urdf_folder: &Path) -> Vec<PathBuf> {
    let package_path = file
        .strip_prefix("package://")
        .or_else(|| file.strip_prefix("model://"));
    let Some((package, rest)) = package_path.and_then(|path| path.split_once('/')) else {
        return vec![urdf_folder.join(file.strip_prefix("file://").unwrap_or(file))];
    };
    let above = urdf_folder
        .ancestors()
        .filter(|folder| !folder.as_os_str().is_empty());
    // Without ROS, there is no index of packages. The folders around the URDF are searched, because
    // a copy of a robot description keeps the layout of its packages.
    let mut candidates = Vec::new();
    for folder in above.clone() {
        if folder.file_name().is_some_and(|name| name == package) {
            candidates.push(folder.join(rest));
        }
        candidates.push(folder.join(package).join(rest));
    }
    candidates.extend(above.map(|folder| folder.join(rest)));
    candidates
}
