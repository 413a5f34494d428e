//! A small simulated rig for end-to-end tests.

use std::path::Path;

/// Factor by which images are smaller than in the shipped rig file, along each side.
const SCALE_DIVISOR: i64 = 4;

/// Timing of the simulation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pace {
    /// Samples are computed when they are requested.
    Lockstep,
    /// Samples arrive in real time, as from devices.
    RealTime,
}

/// Writes `rig.toml` into a folder: `rigs/static-arm.toml` at a quarter of its image size, without
/// sensor imperfections, and the files it refers to.
pub(crate) fn write(folder: &Path, pace: Pace) {
    write_with(folder, |sim| {
        sim.insert("lockstep".into(), (pace == Pace::Lockstep).into());
    });
}

/// Does the same as [`write`], but changes the table `[sim]` first.
pub(crate) fn write_with(folder: &Path, change: impl FnOnce(&mut toml::Table)) {
    let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs");
    let mut rig = shipped(&rigs, "static-arm.toml");
    copy_urdf(&rigs, folder, &rig);
    shrink(rig["camera"]["wrist"].as_table_mut().expect("a camera"));
    let sim = rig["sim"].as_table_mut().expect("a simulation");
    sim.insert("ideal".into(), true.into());
    change(sim);
    std::fs::write(folder.join("rig.toml"), rig.to_string()).expect("the disk has space");
}

/// Writes `rig.toml` into a folder: `rigs/mobile-base-small.toml` in real time, with only its front
/// camera at a quarter of its image size, without sensor imperfections, and the files it refers to.
pub(crate) fn write_base(folder: &Path) {
    let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs");
    let mut rig = shipped(&rigs, "mobile-base-small.toml");
    copy_urdf(&rigs, folder, &rig);
    rig.remove("range");
    // Corrections of the map would look like motions of the base.
    let base = rig["base"].as_table_mut().expect("a base");
    base.insert("realign".into(), false.into());
    // Without the scanner, nothing sees the space around the base.
    let motion = base["motion"].as_table_mut().expect("it is driven");
    motion.insert("allow_unseen".into(), true.into());
    let cameras = rig["camera"].as_table_mut().expect("cameras");
    cameras.remove("rear");
    shrink(cameras["front"].as_table_mut().expect("a camera"));
    let sim = rig["sim"].as_table_mut().expect("a simulation");
    sim.insert("ideal".into(), true.into());
    std::fs::write(folder.join("rig.toml"), rig.to_string()).expect("the disk has space");
}

/// Writes `rig.toml` into a folder: `rigs/mobile-arm.toml` with small images, without sensor
/// imperfections, and the files it refers to.
pub(crate) fn write_mobile_arm(folder: &Path) {
    let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs");
    let mut rig = shipped(&rigs, "mobile-arm.toml");
    copy_urdf(&rigs, folder, &rig);
    let base = rig["base"].as_table_mut().expect("a base");
    base.insert("realign".into(), false.into());
    // The wrist camera sees little of the space around the base.
    let motion = base["motion"].as_table_mut().expect("it is driven");
    motion.insert("allow_unseen".into(), true.into());
    let cameras = rig["camera"].as_table_mut().expect("cameras");
    let wrist = cameras["wrist"].as_table_mut().expect("a camera");
    shrink(wrist);
    shrink(wrist["depth"].as_table_mut().expect("it has depth"));
    let sim = rig["sim"].as_table_mut().expect("a simulation");
    sim.insert("ideal".into(), true.into());
    std::fs::write(folder.join("rig.toml"), rig.to_string()).expect("the disk has space");
}

fn shipped(rigs: &Path, name: &str) -> toml::Table {
    let text = std::fs::read_to_string(rigs.join(name)).expect("a shipped rig file");
    text.parse().expect("TOML")
}

/// Copies the robot description of a rig.
fn copy_urdf(rigs: &Path, folder: &Path, rig: &toml::Table) {
    let urdf = rig["arm"]["urdf"].as_str().expect("a robot");
    std::fs::create_dir_all(folder.join(urdf).parent().expect("inside the folder"))
        .expect("the disk has space");
    std::fs::copy(rigs.join(urdf), folder.join(urdf)).expect("the robot's description");
}

/// Divides the size of the images of a camera.
fn shrink(camera: &mut toml::Table) {
    for (table, key) in [
        ("", "size_px"),
        ("intrinsics", "focal_px"),
        ("intrinsics", "principal_px"),
    ] {
        let holder = if table.is_empty() {
            &mut *camera
        } else {
            camera[table].as_table_mut().expect("a table")
        };
        for number in holder[key].as_array_mut().expect("two numbers") {
            *number = match &*number {
                toml::Value::Integer(whole) => toml::Value::Integer(whole / SCALE_DIVISOR),
                other => {
                    toml::Value::Float(other.as_float().expect("a number") / SCALE_DIVISOR as f64)
                }
            };
        }
    }
}
