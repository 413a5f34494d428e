//! The robot of a new rig file, by name or from a robot description.

use super::wishes::RobotChoice;
use crate::doctor::{Finding, meshes_of};
use crate::known_robots::{BUILTIN_PREFIX, KnownRobot};
use anyhow::Context;
use messages::{BadInput, Setting};
use std::path::{Component, Path, PathBuf};

impl RobotChoice {
    /// The known robot with this name, with or without prefix, or no robot.
    ///
    /// # Errors
    /// If no robot has this name. The error lists the names.
    pub fn named(name: &str) -> Result<Self, BadInput> {
        if name == "none" {
            return Ok(Self::None);
        }
        let name = name.strip_prefix(BUILTIN_PREFIX).unwrap_or(name);
        let robot = KnownRobot::named_by(&format!("{BUILTIN_PREFIX}{name}"));
        let robot =
            robot.map_err(|unknown| BadInput(format!("{}: {unknown}, none", Setting::Robot)))?;
        Ok(robot.map_or(Self::None, Self::Known))
    }

    /// Reads a robot description, and finds its path relative to a rig file.
    ///
    /// * `rig`: path of the rig file. Its folder must exist.
    ///
    /// # Errors
    /// If a file or folder cannot be read.
    pub fn of_urdf(urdf: &Path, rig: &Path) -> anyhow::Result<Self> {
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
        Ok(Self::Urdf {
            path: path.display().to_string(),
            text,
        })
    }
}

impl RobotChoice {
    /// Warnings about the mesh files that the robot description names.
    ///
    /// * `rig`: path of the rig file.
    #[must_use]
    pub fn mesh_warnings(&self, rig: &Path) -> Vec<Finding> {
        let Self::Urdf { path, text } = self else {
            return Vec::new();
        };
        let urdf = rig.with_file_name(path);
        let urdf = std::path::absolute(&urdf).unwrap_or(urdf);
        meshes_of(text, urdf.parent().unwrap_or(Path::new("")))
    }
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

    #[test]
    fn robots_are_named_with_or_without_prefix() {
        for name in ["ur5e", "builtin:ur5e", "UR5e"] {
            let robot = RobotChoice::named(name).expect(name);
            assert!(matches!(robot, RobotChoice::Known(robot) if robot.name == "ur5e"));
        }
        assert_eq!(
            RobotChoice::named("none").expect("no arm"),
            RobotChoice::None
        );
        let error = RobotChoice::named("ur5").expect_err("unknown").to_string();
        assert!(
            error.contains("a UR5 has a shoulder") && error.ends_with("so101, none"),
            "{error}"
        );
    }
}
