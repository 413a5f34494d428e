//! The robot of a rig as viewers draw it, with the mesh files that its URDF names.

use anyhow::Context;
use capture::config::{ArmDriver, Rig, UrdfFolder};
use files::Budget;
use kinematics::shape::Geometry;
use kinematics::urdf::Robot;
use std::collections::BTreeSet;
use viz::{MeshFormat, RobotDescription, RobotMesh};

/// The robot of a rig; `None` if the rig has neither an arm nor a moving base. A shape that cannot
/// be drawn causes only a warning.
///
/// # Errors
///
/// If the URDF is invalid, which [`Rig::load`] rules out.
pub fn description(rig: &Rig) -> anyhow::Result<Option<RobotDescription>> {
    if rig.arm.driver == ArmDriver::None && !rig.has_moving_base() {
        return Ok(None);
    }
    let robot = Robot::parse(&rig.arm.urdf_text).context("the arm's URDF")?;
    let meshes = meshes(&robot, &rig.arm.urdf_folder);
    Ok(Some(RobotDescription {
        robot,
        base_link: rig.arm.base_link.clone(),
        joint_names: rig.arm.joints.clone(),
        meshes,
    }))
}

/// Reads the mesh files of all visual shapes.
fn meshes(robot: &Robot, urdf_folder: &UrdfFolder) -> Vec<RobotMesh> {
    let shapes = robot.links().iter().flat_map(|link| robot.visuals(link));
    let mut files: Vec<&str> = shapes
        .filter_map(|shape| match &shape.geometry {
            Geometry::Mesh { file, .. } => Some(file.as_str()),
            _ => None,
        })
        .collect();
    // Several links often share a mesh, such as the mesh of a joint module.
    let mut named = BTreeSet::new();
    files.retain(|file| named.insert(*file));
    let mut meshes: Vec<RobotMesh> = Vec::new();
    let mut budget = Budget::MESHES;
    let mut failures = Vec::new();
    for file in &files {
        match read(file, urdf_folder, budget) {
            Ok(mesh) => {
                // The total size of all meshes is limited, because every client gets them.
                budget = budget.after(mesh.bytes.len() as u64);
                meshes.push(mesh);
            }
            Err(why) => failures.push(format!("{file:?}: {why}")),
        }
    }
    if let Some(warning) = describe(&failures, files.len()) {
        log::warn!("{warning}");
    }
    meshes
}

/// One warning for all meshes that cannot be drawn, because they usually have the same cause.
fn describe(failures: &[String], n_files: usize) -> Option<String> {
    let first = failures.first()?;
    let others = match failures.len() - 1 {
        0 => String::new(),
        n => format!("; and {}", messages::counted(n as u64, "other")),
    };
    Some(format!(
        "the robot is drawn without {} of {}: {first}{others}",
        failures.len(),
        messages::counted(n_files as u64, "mesh file"),
    ))
}

/// Reads a mesh file. The error is the reason, in one sentence.
fn read(file: &str, urdf_folder: &UrdfFolder, left: Budget) -> Result<RobotMesh, String> {
    let format = MeshFormat::of_file(file)
        .ok_or("its type is not supported, convert it to .stl, .dae or .obj")?;
    // The budget of one file, but not more than the rest of the budget of all files.
    let budget = Budget {
        max_bytes: Budget::MESH.max_bytes.min(left.max_bytes),
        ..Budget::MESH
    };
    Ok(RobotMesh {
        file: file.to_owned(),
        format,
        bytes: urdf_folder.read_mesh(file, budget)?.into(),
    })
}

#[cfg(test)]
mod tests {
    use super::{describe, meshes, read};
    use capture::MeshKind;
    use capture::config::UrdfFolder;
    use files::Budget;
    use kinematics::urdf::Robot;
    use std::path::Path;
    use viz::MeshFormat;

    fn robot(files: &[&str]) -> Robot {
        let mesh = |file: &&str| {
            format!(r#"<visual><geometry><mesh filename="{file}"/></geometry></visual>"#)
        };
        let shapes: String = files.iter().map(mesh).collect();
        Robot::parse(&format!(
            r#"<robot name="r"><link name="a">{shapes}</link></robot>"#
        ))
        .expect("a robot")
    }

    fn write(path: &Path, contents: &str) {
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("created");
        std::fs::write(path, contents).expect("written");
    }

    #[test]
    fn meshes_are_found_beside_the_urdf_and_in_packages() {
        let folder = tempfile::tempdir().expect("a folder");
        let root = folder.path();
        write(&root.join("arm_description/meshes/a.stl"), "a");
        write(&root.join("arm_description/urdf/b.obj"), "b");
        write(&root.join("hand_description/c.dae"), "c");
        let files = [
            "package://arm_description/meshes/a.stl",
            "b.obj",
            "package://hand_description/c.dae",
            "b.obj",
            "missing.stl",
            "package://arm_description/meshes/a.txt",
        ];
        let folder = UrdfFolder::at(&root.join("arm_description/urdf"));
        let found = meshes(&robot(&files), &folder);
        let found: Vec<_> = found
            .iter()
            .map(|mesh| (&*mesh.file, mesh.format, mesh.bytes[0]))
            .collect();
        let expected = [
            (files[0], MeshFormat::Stl, b'a'),
            (files[1], MeshFormat::Obj, b'b'),
            (files[2], MeshFormat::Dae, b'c'),
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn a_package_may_be_in_a_folder_with_another_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let root = folder.path();
        write(&root.join("checkout/arm/meshes/a.stl"), "a");
        let file = "package://arm_description/arm/meshes/a.stl";
        let folder = UrdfFolder::at(&root.join("checkout/arm/urdf"));
        let found = meshes(&robot(&[file]), &folder);
        assert_eq!(found[0].file, file);
    }

    #[test]
    fn one_warning_describes_all_missing_meshes() {
        let folder = tempfile::tempdir().expect("a folder");
        let folder = UrdfFolder::at(folder.path());
        let why = |file| read(file, &folder, Budget::MESHES).expect_err("missing");
        let missing = why("package://arm/meshes/a.stl");
        assert!(
            missing.starts_with("no file \"meshes/a.stl\" in a folder \"arm\" beside or above"),
            "{missing}"
        );
        assert!(why("b.stl").starts_with("no such file"));
        let failures = ["a".to_owned(), "b".to_owned(), "c".to_owned()];
        assert_eq!(
            describe(&failures, 5).expect("a warning"),
            "the robot is drawn without 3 of 5 mesh files: a; and 2 others"
        );
        assert!(describe(&[], 5).is_none());
    }
    #[test]
    fn the_page_draws_the_kinds_that_doctor_says() {
        for (file, kind) in [
            ("a.STL", MeshKind::Triangles),
            ("a.obj", MeshKind::Triangles),
            ("a.dae", MeshKind::Triangles),
            ("a.glb", MeshKind::Unsupported),
            ("stl", MeshKind::Unsupported),
        ] {
            assert_eq!(MeshKind::of(file), kind, "{file}");
            let is_drawn = MeshFormat::of_file(file).is_some();
            assert_eq!(is_drawn, kind != MeshKind::Unsupported, "{file}");
        }
    }
}
