//! The robot description of a new rig file, with its path relative to the rig file.

use anyhow::Context;
use capture::init::RobotChoice;
use std::path::{Component, Path, PathBuf};

/// Reads a robot description.
pub(super) fn urdf(urdf: &Path, rig: &Path) -> anyhow::Result<RobotChoice> {
    let text = files::read_text(urdf)
        .with_context(|| format!("cannot read the robot description {}", urdf.display()))?;
    let folder = match rig.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let absolute = |path: &Path| {
        std::fs::canonicalize(path).with_context(|| format!("cannot find {}", path.display()))
    };
    let path = relative(&absolute(folder)?, &absolute(urdf)?);
    Ok(RobotChoice::Urdf {
        path: path.display().to_string(),
        text,
    })
}

/// The path of a file relative to a folder. Both are absolute. The path stays absolute if they have
/// nothing in common, so that it does not consist of steps upwards only.
fn relative(folder: &Path, file: &Path) -> PathBuf {
    let is_named = |part: &Component<'_>| matches!(part, Component::Normal(_));
    let n_common = std::iter::zip(folder.components(), file.components())
        .take_while(|(a, b)| a == b)
        .count();
    if !file.components().take(n_common).any(|part| is_named(&part)) {
        return file.to_owned();
    }
    let upwards = folder
        .components()
        .skip(n_common)
        .map(|_| Component::ParentDir);
    upwards.chain(file.components().skip(n_common)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_relative_to_the_folder_of_the_rig() {
        for (folder, file, expected) in [
            ("/a/b", "/a/b/arm.urdf", "arm.urdf"),
            ("/a/b", "/a/b/c/arm.urdf", "c/arm.urdf"),
            ("/a/b", "/a/arm.urdf", "../arm.urdf"),
            ("/a/b/c", "/a/d/arm.urdf", "../../d/arm.urdf"),
            ("/a/b", "/opt/arm.urdf", "/opt/arm.urdf"),
        ] {
            assert_eq!(
                relative(Path::new(folder), Path::new(file)),
                Path::new(expected)
            );
        }
    }
}
