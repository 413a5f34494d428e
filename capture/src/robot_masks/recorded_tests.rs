//! Masks of a replay on a computer without the robot's mesh files.

use super::tests::{keyframes, n_masked, rig, samples};
use crate::config::{Rig, UrdfFolder};
use crate::join::Join;
use crate::open;
use crate::recorded_meshes::RecordedMeshes;
use files::Budget;
use keyframe::Keyframe;
use std::path::Path;
use std::sync::Arc;

const MESH: &str = "meshes/tool.stl";
/// Speed of the first joint, rad/s.
const SPEED_RAD_S: f64 = 0.4;

/// A text STL file of a large tetrahedron.
fn stl() -> String {
    let corners = [
        [0.0, 0.0, 0.0],
        [0.3, 0.0, 0.0],
        [0.0, 0.3, 0.0],
        [0.0, 0.0, 0.3],
    ];
    let facet = |ixs: [usize; 3]| -> String {
        let vertices = ixs.map(|ix| {
            let [x, y, z] = corners[ix];
            format!("vertex {x} {y} {z}\n")
        });
        format!(
            "facet\nouter loop\n{}endloop\nendfacet\n",
            vertices.concat()
        )
    };
    let facets = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]].map(facet);
    format!("solid tool\n{}endsolid\n", facets.concat())
}

/// A rig whose arm holds a tool with the shape of a mesh in a folder.
fn rig_with_tool(folder: &Path) -> Rig {
    let mut rig = rig(&[]);
    let tool = format!(
        r#"<link name="tool"><visual><geometry><mesh filename="{MESH}"/></geometry></visual></link>
           <joint name="mount" type="fixed"><parent link="panda_link8"/><child link="tool"/></joint></robot>"#
    );
    rig.arm.urdf_text = rig.arm.urdf_text.replacen("</robot>", &tool, 1);
    rig.arm.mesh_folder = Some(folder.to_string_lossy().into_owned());
    rig.arm.urdf_folder = UrdfFolder::at(folder);
    rig
}

fn joined(rig: &Rig) -> Vec<Arc<Keyframe>> {
    keyframes(
        &mut Join::new(rig).expect("a good rig"),
        samples(SPEED_RAD_S),
    )
}

fn record(path: &Path, rig: &Rig, meshes: &RecordedMeshes) {
    let mut recorder = open::recorder(path, rig, meshes).expect("a new file");
    for sample in samples(SPEED_RAD_S) {
        recorder.write(&sample).expect("disk space");
    }
    recorder.finish().expect("disk space");
}

/// The keyframes of a replay with the stored rig, or with another one.
fn replayed(path: &Path, rig: Option<Rig>) -> (Rig, Vec<Arc<Keyframe>>) {
    let mut opened = open::recording(path, rig, &[]).expect("a recording");
    let mut read = Vec::new();
    while let Some(sample) = opened.source.next_sample().expect("readable") {
        read.push(sample);
    }
    let mut join = Join::new(&opened.rig).expect("a good rig");
    let keyframes = keyframes(&mut join, read);
    (opened.rig, keyframes)
}

fn are_equal(one: &[Arc<Keyframe>], other: &[Arc<Keyframe>]) -> bool {
    let depth = |keyframe: &Keyframe| {
        let depth = keyframe.depth.as_ref().expect("depth");
        depth.depth_m.clone()
    };
    one.len() == other.len()
        && one
            .iter()
            .zip(other)
            .all(|(one, other)| one.rgba_srgb == other.rgba_srgb && depth(one) == depth(other))
}

#[test]
fn a_replay_without_the_mesh_files_masks_the_robot_as_the_live_run() {
    let root = tempfile::tempdir().expect("a folder");
    let robot = root.path().join("robot");
    std::fs::create_dir_all(robot.join("meshes")).expect("a folder");
    std::fs::write(robot.join(MESH), stl()).expect("written");
    let rig = rig_with_tool(&robot);
    let live = joined(&rig);
    let meshes = open::meshes_to_record(&rig);
    let [path, again, old] = ["a.mcap", "b.mcap", "old.mcap"].map(|name| root.path().join(name));
    record(&path, &rig, &meshes);
    record(&again, &rig, &open::meshes_to_record(&rig));
    record(&old, &rig, &RecordedMeshes::default());
    let bytes = |path: &Path| std::fs::read(path).expect("the recording");
    assert!(bytes(&path) == bytes(&again), "recordings are reproducible");
    std::fs::remove_dir_all(&robot).expect("a folder");

    let (stored, keyframes) = replayed(&path, None);
    assert!(!live.is_empty() && are_equal(&live, &keyframes));
    let page = stored.arm.urdf_folder.read_mesh(MESH, Budget::MESH);
    assert_eq!(page, Ok(stl().into_bytes()), "for the page");
    // A rig file that names the missing folder also gets the meshes of the recording.
    let (_, keyframes) = replayed(&path, Some(rig));
    assert!(are_equal(&live, &keyframes));

    let (stored, without) = replayed(&old, None);
    assert!(n_masked(&without[0]) + 100 < n_masked(&live[0]));
    let masks = super::RobotMasks::new(&stored).expect("a good rig");
    let warning = masks.and_then(|masks| masks.warning()).expect("no shape");
    assert!(
        warning.contains("the recording contains no mesh files, like recordings of older versions"),
        "{warning}"
    );
}

#[test]
fn meshes_of_the_recording_replace_other_files_of_the_same_name() {
    let root = tempfile::tempdir().expect("a folder");
    std::fs::create_dir(root.path().join("meshes")).expect("a folder");
    let file = root.path().join(MESH);
    std::fs::write(&file, stl()).expect("written");
    let rig = rig_with_tool(root.path());
    let live = joined(&rig);
    let path = root.path().join("a.mcap");
    record(&path, &rig, &open::meshes_to_record(&rig));
    std::fs::write(&file, stl().replace("0.3", "0.02")).expect("written");
    let (stored, keyframes) = replayed(&path, None);
    assert!(are_equal(&live, &keyframes));
    // Recording a replay keeps the meshes.
    let copy = root.path().join("copy.mcap");
    record(&copy, &stored, &open::meshes_to_record(&stored));
    std::fs::remove_file(&file).expect("there");
    assert!(are_equal(&live, &replayed(&copy, None).1));
}
