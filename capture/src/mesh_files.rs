//! Finds the mesh files that a robot description names.

use std::path::{Path, PathBuf};

/// Paths where a mesh file may be, the most likely one first. The folder of a package is a parent
/// folder of the URDF, or beside such a parent. Usually, it has the name of the package. A parent
/// folder with another name may be the package, too: a checkout or a download is often renamed.
#[must_use]
pub fn mesh_file_candidates(file: &str, urdf_folder: &Path) -> Vec<PathBuf> {
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
