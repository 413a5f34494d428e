//! Checks the mesh files that a robot description names. Without them, a run works, but the robot is
//! not drawn, and steering does not know the size of its parts.

use super::Finding;
use crate::config::Rig;
use crate::mesh_files::{MeshKind, found_mesh_file, missing_mesh_file};
use kinematics::shape::{Geometry, Shape};
use kinematics::urdf::Robot;
use messages::counted;
use std::collections::BTreeSet;
use std::path::Path;

const CHECK: &str = "meshes";

/// Warnings about mesh files that are missing, or that cannot be read: one for each reason.
#[must_use]
pub fn meshes(rig: &Rig) -> Vec<Finding> {
    // Known robots have no folder, and no mesh files.
    let folder = rig.arm.urdf_folder.path();
    folder.map_or_else(Vec::new, |folder| meshes_of(&rig.arm.urdf_text, folder))
}

/// Like [`meshes`], for the text of a URDF. An invalid URDF has no warnings.
///
/// * `folder`: absolute path of the folder of the URDF.
#[must_use]
pub fn meshes_of(urdf: &str, folder: &Path) -> Vec<Finding> {
    let Ok(robot) = Robot::parse(urdf) else {
        return Vec::new();
    };
    let named = NamedMeshes::of(&robot);
    let (found, missing): (Vec<&str>, Vec<&str>) = named
        .files
        .iter()
        .copied()
        .partition(|file| found_mesh_file(file, folder).is_some());
    let of_kind = |kind: MeshKind| -> Vec<&str> {
        let files = found.iter().copied();
        files.filter(|file| MeshKind::of(file) == kind).collect()
    };
    let simpler = "the robot is drawn without them, or with simpler shapes";
    let convert = |_: &str| "convert them to .stl, .dae or .obj".to_owned();
    let findings = [
        named.warning(&missing, "missing", simpler, |first| {
            missing_mesh_file(first, folder)
        }),
        named.warning(
            &of_kind(MeshKind::Unsupported),
            "of a kind that cannot be read",
            simpler,
            convert,
        ),
    ];
    findings.into_iter().flatten().collect()
}

/// The mesh files that a robot description names, each once.
struct NamedMeshes<'a> {
    files: Vec<&'a str>,
    /// Files of the shapes from which steering computes distances.
    of_bodies: BTreeSet<&'a str>,
}

impl<'a> NamedMeshes<'a> {
    fn of(robot: &'a Robot) -> Self {
        let mut meshes = Self {
            files: Vec::new(),
            of_bodies: BTreeSet::new(),
        };
        let mut seen = BTreeSet::new();
        for link in robot.links() {
            let (visuals, collisions) = (robot.visuals(link), robot.collisions(link));
            let all = files_of(visuals).chain(files_of(collisions));
            meshes.files.extend(all.filter(|file| seen.insert(*file)));
            // Steering uses visual shapes only for links without collision shapes.
            let body = if collisions.is_empty() {
                visuals
            } else {
                collisions
            };
            meshes.of_bodies.extend(files_of(body));
        }
        meshes
    }

    /// A warning about some of the files; `None` if there are none.
    ///
    /// * `state`: why they cannot be used, after "are".
    /// * `loss`: what the run lacks without them.
    /// * `remedy`: what to do about the first file.
    fn warning(
        &self,
        files: &[&str],
        state: &str,
        loss: &str,
        remedy: impl FnOnce(&str) -> String,
    ) -> Option<Finding> {
        let first = files.first()?;
        let message = format!(
            "{} {state}, the first is {first:?}: {loss}{}",
            self.part(files),
            self.without_distance(files)
        );
        Some(Finding::warn(CHECK, message, remedy(first)))
    }

    /// How many of the files are meant, as the beginning of a sentence.
    fn part(&self, files: &[&str]) -> String {
        format!(
            "{} of {} of the robot description {}",
            files.len(),
            counted(self.files.len() as u64, "mesh file"),
            if files.len() == 1 { "is" } else { "are" }
        )
    }

    /// What the files mean for steering, as the end of a sentence.
    fn without_distance(&self, files: &[&str]) -> &'static str {
        if files.iter().any(|file| self.of_bodies.contains(file)) {
            ", and a steered arm keeps no distance between these parts and the scene"
        } else {
            ""
        }
    }
}

/// The mesh files of shapes.
fn files_of(shapes: &[Shape]) -> impl Iterator<Item = &str> {
    shapes.iter().filter_map(|shape| match &shape.geometry {
        Geometry::Mesh { file, .. } => Some(file.as_str()),
        _ => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fmt::Write;

    /// Warnings about a robot whose links have these visual mesh files, and these collision meshes.
    /// Only the files in the list `existing` exist.
    fn warnings(visuals: &[&str], collisions: &[&str], existing: &[&str]) -> Vec<String> {
        let folder = tempfile::tempdir().expect("a folder");
        let mut shapes = String::new();
        for (kind, files) in [("visual", visuals), ("collision", collisions)] {
            for file in files {
                let _ = write!(
                    shapes,
                    "<{kind}><geometry><mesh filename=\"{file}\"/></geometry></{kind}>"
                );
            }
        }
        let urdf = format!("<robot name=\"r\"><link name=\"base\">{shapes}</link></robot>");
        let rig = "[arm]\ndriver = \"none\"\nurdf = \"r.urdf\"\nflange_link = \"base\"\n\
                   [camera.c]\ndriver = \"sim\"\nsize_px = [64, 48]\nrate_hz = 1\nparent = \"world\"\n";
        for (name, text) in [("r.urdf", &*urdf), ("rig.toml", rig)] {
            std::fs::write(folder.path().join(name), text).expect("written");
        }
        for name in existing {
            std::fs::write(folder.path().join(name), "mesh").expect("written");
        }
        let rig = Rig::load(&folder.path().join("rig.toml"), &[]).expect("a valid rig");
        let shown = folder.path().display().to_string();
        meshes(&rig)
            .iter()
            .map(|finding| finding.to_string().replace(&shown, "FOLDER"))
            .collect()
    }

    #[test]
    fn readable_meshes_cause_no_warning() {
        assert_eq!(
            warnings(
                &["a.stl", "b.OBJ"],
                &["a.stl", "c.dae"],
                &["a.stl", "b.OBJ", "c.dae"]
            ),
            [""; 0]
        );
        assert_eq!(warnings(&[], &[], &[]), [""; 0]);
    }

    #[test]
    fn one_warning_counts_all_missing_meshes() {
        assert_eq!(
            warnings(
                &["a.stl", "package://arm/meshes/b.stl", "c.dae"],
                &["a.stl"],
                &["a.stl"]
            ),
            [
                "2 of 3 mesh files of the robot description are missing, the first is \"package://arm/meshes/b.stl\": the robot \
                 is drawn without them, or with simpler shapes; no file \"meshes/b.stl\" in a folder \"arm\" beside or above \
                 FOLDER; copy the whole package of the URDF"
            ]
        );
        // Without collision shapes, steering needs the visual ones.
        assert_eq!(
            warnings(&["a.stl"], &[], &[]),
            [
                "1 of 1 mesh file of the robot description is missing, the first is \"a.stl\": the robot is drawn without them, or \
                 with simpler shapes, and a steered arm keeps no distance between these parts and the scene; no such file; \
                 relative names start at FOLDER"
            ]
        );
    }

    #[test]
    fn meshes_of_unreadable_kinds_are_named_with_what_is_lost() {
        let found = warnings(
            &["a.dae", "b.glb", "c.stl"],
            &["c.stl"],
            &["a.dae", "b.glb", "c.stl"],
        );
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(
            found[0].contains("of a kind that cannot be read, the first is \"b.glb\""),
            "{found:?}"
        );
    }
}
