//! Collects the mesh files of a robot for a recording.

use crate::config::{Rig, UrdfFolder};
use crate::recorded_meshes::RecordedMeshes;
use drivers::recording::{MAX_MESH_BYTES, compress_mesh};
use files::Budget;
use kinematics::shape::Geometry;
use kinematics::urdf::Robot;
use messages::counted;
use std::collections::BTreeSet;

/// Reads and compresses the mesh files of a robot. The files of collision shapes come first,
/// because they are small and protect the robot. Warns about files that are left out, because they
/// cannot be read or because all files together would be too large.
///
/// This takes a second for large meshes, so call it before devices are opened.
#[must_use]
pub fn meshes_to_record(rig: &Rig) -> RecordedMeshes {
    // Opening a rig checks its URDF. A rig without a valid one has no meshes.
    let robot = Robot::parse(&rig.arm.urdf_text).ok();
    let files = robot.as_ref().map_or_else(Vec::new, mesh_files_of);
    let (meshes, left_out) = compressed(&files, &rig.arm.urdf_folder, MAX_MESH_BYTES);
    if let Some(warning) = describe(&left_out, files.len()) {
        log::warn!("{warning}");
    }
    meshes
}

/// Names of the mesh files of a robot, each once.
fn mesh_files_of(robot: &Robot) -> Vec<&str> {
    let collisions = robot.links().iter().flat_map(|link| robot.collisions(link));
    let visuals = robot.links().iter().flat_map(|link| robot.visuals(link));
    let mut seen = BTreeSet::new();
    collisions
        .chain(visuals)
        .filter_map(|shape| match &shape.geometry {
            Geometry::Mesh { file, .. } => Some(file.as_str()),
            _ => None,
        })
        .filter(|file| seen.insert(*file))
        .collect()
}

/// The compressed files, and the reason for each file that is left out.
///
/// * `max_bytes`: maximum size of all compressed files.
fn compressed(
    files: &[&str],
    folder: &UrdfFolder,
    max_bytes: u64,
) -> (RecordedMeshes, Vec<String>) {
    let mut meshes = Vec::new();
    let mut left_out = Vec::new();
    let mut n_bytes = 0;
    for file in files {
        let bytes = match folder.read_mesh(file, Budget::MESH) {
            Ok(bytes) => compress_mesh(&bytes),
            Err(why) => {
                left_out.push(format!("{file:?}: {why}"));
                continue;
            }
        };
        let with_this = n_bytes + bytes.len() as u64;
        if with_this > max_bytes {
            left_out.push(format!(
                "{file:?}: all mesh files together would exceed {} MiB after compression; reduce the number of triangles",
                max_bytes >> 20
            ));
            continue;
        }
        n_bytes = with_this;
        meshes.push(((*file).to_owned(), bytes));
    }
    (RecordedMeshes::of_compressed(meshes), left_out)
}

/// One warning for all files that are left out; `None` if there are none.
fn describe(left_out: &[String], n_files: usize) -> Option<String> {
    let first = left_out.first()?;
    let others = match left_out.len() - 1 {
        0 => String::new(),
        n => format!("; and {}", counted(n as u64, "other")),
    };
    Some(format!(
        "the recording lacks {} of {}, so a replay on another computer masks and draws the robot without them: {first}{others}",
        left_out.len(),
        counted(n_files as u64, "mesh file"),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    const URDF: &str = r#"<robot name="r"><link name="base">
        <visual><geometry><mesh filename="v.stl"/></geometry></visual>
        <visual><geometry><mesh filename="gone.dae"/></geometry></visual>
        <collision><geometry><mesh filename="c.stl"/></geometry></collision>
        <collision><geometry><mesh filename="v.stl"/></geometry></collision>
        </link></robot>"#;

    #[test]
    fn meshes_are_collected_once_and_left_out_if_missing_or_too_large() {
        let root = tempfile::tempdir().expect("a folder");
        // Bytes that hardly compress.
        let noise = |n: u32| -> Vec<u8> {
            (0..n)
                .flat_map(|ix| ix.wrapping_mul(2_654_435_761).to_le_bytes())
                .collect()
        };
        for (name, n) in [("v.stl", 1000), ("c.stl", 10)] {
            std::fs::write(root.path().join(name), noise(n)).expect("written");
        }
        let robot = Robot::parse(URDF).expect("a robot");
        let files = mesh_files_of(&robot);
        assert_eq!(files, ["c.stl", "v.stl", "gone.dae"]);
        let folder = UrdfFolder::at(root.path());
        let (meshes, left_out) = compressed(&files, &folder, MAX_MESH_BYTES);
        let names: Vec<&str> = meshes.compressed().map(|(file, _)| file).collect();
        assert_eq!(names, ["c.stl", "v.stl"]);
        assert_eq!(
            meshes.read("c.stl", Budget::MESH).expect("stored"),
            noise(10)
        );
        assert_eq!(left_out.len(), 1);
        assert!(left_out[0].starts_with("\"gone.dae\": no such file"));
        let (meshes, left_out) = compressed(&files, &folder, 1000);
        assert_eq!(meshes.compressed().count(), 1);
        let warning = describe(&left_out, files.len()).expect("a warning");
        assert!(
            warning.starts_with("the recording lacks 2 of 3 mesh files")
                && warning.contains("\"v.stl\": all mesh files together")
                && warning.ends_with("; and 1 other"),
            "{warning}"
        );
        assert_eq!(describe(&[], 3), None);
    }
}
