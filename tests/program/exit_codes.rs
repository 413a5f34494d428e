//! Tests when images that devices drop change the exit code.

use crate::command::{fieldrig, stderr};
use crate::small_rig;
use std::path::Path;

/// Exit code of a result that lacks data.
const LOSS: i32 = 3;

/// Writes a rig whose simulated camera loses half of its images.
fn write_lossy_rig(folder: &Path) {
    small_rig::write_with(folder, |sim| {
        sim.insert("lockstep".into(), true.into());
        // An ideal camera loses nothing.
        sim.insert("ideal".into(), false.into());
    });
    let file = folder.join("rig.toml");
    let text = std::fs::read_to_string(&file).expect("just written");
    let mut rig: toml::Table = text.parse().expect("TOML");
    let camera = rig["camera"]["wrist"].as_table_mut().expect("a camera");
    camera
        .entry("sim")
        .or_insert_with(|| toml::Table::new().into())
        .as_table_mut()
        .expect("a table")
        .insert("dropped_frac".into(), 0.5.into());
    std::fs::write(&file, rig.to_string()).expect("the disk has space");
}

/// Number of images that the devices of a run have dropped.
fn n_dropped(run: &Path) -> u64 {
    let text = std::fs::read_to_string(run.join("report.json")).expect("a report");
    let report: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    report["device_skipped"].as_u64().expect("a count")
}

#[test]
fn dropped_images_are_a_loss_only_if_they_are_recorded() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write_lossy_rig(folder);
    let run = "run rig.toml --sim --lockstep --steps 5 --listen 127.0.0.1:0 --out";
    for (out, record, code) in [("watched", None, 0), ("recorded", Some("scan.mcap"), LOSS)] {
        let mut args: Vec<&str> = run.split(' ').chain([out]).collect();
        args.extend(record.into_iter().flat_map(|file| ["--record", file]));
        let output = fieldrig(folder, &args);
        assert_eq!(output.status.code(), Some(code), "{}", stderr(&output));
        assert!(n_dropped(&folder.join(out)) > 0, "{out}");
    }
}
