//! The rig files of README and guides: every TOML block is read, and complete rig files are
//! simulated.

use super::{Devices, rig};
use crate::config::{Override, Rig};
use crate::known_robots::KNOWN_ROBOTS;
use drivers::Sample;
use std::path::{Path, PathBuf};

/// Pages whose blocks are only parts of the rig file of an arm with other motors, and the reason.
const PARTS: [(&str, &str, &str); 3] = [
    (
        "arms.md",
        "[arm.motor.joint1]",
        "shows one motor of several, with all of its keys",
    ),
    (
        "moving-arms.md",
        "[arm.motion]",
        "is added to the rig file of a CAN arm",
    ),
    (
        "steering.md",
        "[arm.motion.steering]",
        "is added to a rig file with [arm.motion]",
    ),
];

/// What a block without an arm is added to.
const ARM: &str = "[arm]\ndriver = \"udp\"\nurdf = \"builtin:panda\"\n";

/// What a block without a camera is added to.
const CAMERA: &str = "\n[camera.test]\ndriver = \"realsense\"\nsize_px = [640, 480]\nrate_hz = 30\nparent = \"flange\"\n\
                      parent_from_camera = { xyz_m = [0.0, 0.06, 0.04], quat_xyzw = [0.0, 0.0, 0.0, 1.0] }\n";

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// README and all guides: their names and texts.
fn pages() -> Vec<(String, String)> {
    let guides = std::fs::read_dir(repository().join("docs/guide")).expect("a folder");
    let mut paths: Vec<PathBuf> = guides
        .map(|entry| entry.expect("readable").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "md"))
        .collect();
    paths.push(repository().join("README.md"));
    paths.sort();
    let read = |path: &PathBuf| std::fs::read_to_string(path).expect("a text");
    let name = |path: &Path| {
        path.file_name()
            .expect("a file")
            .to_string_lossy()
            .into_owned()
    };
    paths.iter().map(|path| (name(path), read(path))).collect()
}

/// The TOML blocks of a page, without the indentation of lists.
fn blocks(page: &str) -> Vec<String> {
    let mut blocks = Vec::new();
    let mut block: Option<String> = None;
    for line in page.lines().map(str::trim) {
        match (&mut block, line) {
            (None, "```toml") => block = Some(String::new()),
            (Some(_), "```") => blocks.extend(block.take()),
            (Some(text), line) => {
                text.push_str(line);
                text.push('\n');
            }
            (None, _) => {}
        }
    }
    blocks
}

/// A URDF with the joints `joint1` to `joint6`, as in the guide to CAN arms.
fn can_arm_urdf() -> String {
    let mut urdf = include_str!("../../../sim/tests/robots/bench6.urdf").to_owned();
    for number in 1..=6 {
        urdf = urdf.replace(
            &format!("name=\"j{number}\""),
            &format!("name=\"joint{number}\""),
        );
    }
    urdf
}

/// A folder with the robot descriptions that the pages name.
fn folder_with_robots() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let ur5e = KNOWN_ROBOTS.iter().find(|robot| robot.name == "ur5e");
    let ur5e = ur5e.expect("a known robot").urdf;
    for (name, urdf) in [("my-arm.urdf", &*can_arm_urdf()), ("my-ur5e.urdf", ur5e)] {
        std::fs::write(folder.path().join(name), urdf).expect("written");
    }
    folder
}

fn has_table(block: &str, table: &str) -> bool {
    block.lines().any(|line| line.starts_with(table))
}

fn expect_images_in_simulation(path: &Path, text: &str) {
    let overrides = [
        Override::new("sim.lockstep", true),
        Override::new("sim.n_images", 2),
    ];
    let loaded = Rig::load(path, &overrides).unwrap_or_else(|error| panic!("{error:#}: {text}"));
    let mut opened = rig(loaded, Devices::Sim).unwrap_or_else(|error| panic!("{error:#}: {text}"));
    let mut n_images = 0;
    while let Some(sample) = opened.source.next_sample().expect("the rig runs") {
        n_images += usize::from(matches!(&sample, Sample::Image(image) if !image.is_depth()));
    }
    assert!(n_images >= 2, "{text}");
}

#[test]
fn rig_files_in_the_documentation_are_simulated() {
    let folder = folder_with_robots();
    let path = folder.path().join("rig.toml");
    let mut n_simulated = 0;
    for (_, page) in pages() {
        for block in blocks(&page) {
            if has_table(&block, "[arm]") && has_table(&block, "[camera.") {
                std::fs::write(&path, &block).expect("written");
                expect_images_in_simulation(&path, &block);
                n_simulated += 1;
            }
        }
    }
    assert!(n_simulated >= 6, "{n_simulated} rig files");
}

#[test]
fn parts_of_rig_files_in_the_documentation_are_read() {
    let folder = folder_with_robots();
    let path = folder.path().join("rig.toml");
    let mut n_read = 0;
    let mut unused = PARTS.to_vec();
    for (name, page) in pages() {
        for block in blocks(&page) {
            toml::from_str::<toml::Table>(&block)
                .unwrap_or_else(|error| panic!("{name}: {error}: {block}"));
            let is_part =
                |(page, table, _): &(&str, &str, &str)| *page == name && has_table(&block, table);
            if PARTS.iter().any(is_part) {
                unused.retain(|part| !is_part(part));
                continue;
            }
            let arm = if has_table(&block, "[arm]") { "" } else { ARM };
            let camera = if has_table(&block, "[camera.") {
                ""
            } else {
                CAMERA
            };
            std::fs::write(&path, format!("{arm}{block}{camera}")).expect("written");
            Rig::load(&path, &[]).unwrap_or_else(|error| panic!("{name}: {error:#}: {block}"));
            n_read += 1;
        }
    }
    assert_eq!(unused, []);
    assert!(n_read > 12, "{n_read} blocks");
}
