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
    let text = std::fs::read_to_string(rigs.join("static-arm.toml")).expect("a shipped rig file");
    let mut rig: toml::Table = text.parse().expect("TOML");
    let urdf = rig["arm"]["urdf"].as_str().expect("a robot").to_owned();
    std::fs::create_dir_all(folder.join(&urdf).parent().expect("inside the folder"))
        .expect("the disk has space");
    std::fs::copy(rigs.join(&urdf), folder.join(&urdf)).expect("the robot's description");
    let wrist = rig["camera"]["wrist"].as_table_mut().expect("a camera");
    for (table, key) in [
        ("", "size_px"),
        ("intrinsics", "focal_px"),
        ("intrinsics", "principal_px"),
    ] {
        let holder = if table.is_empty() {
            &mut *wrist
        } else {
            wrist[table].as_table_mut().expect("a table")
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
    let sim = rig["sim"].as_table_mut().expect("a simulation");
    sim.insert("ideal".into(), true.into());
    change(sim);
    std::fs::write(folder.join("rig.toml"), rig.to_string()).expect("the disk has space");
}
