//! Tests several methods that train in parallel on the same images: each gives the same result as
//! alone, in its own folder.

use crate::command::assert_one_error;
use crate::wall;
use crate::wall::fieldrig;
use serde_json::{Value, json};
use std::path::Path;

/// Steps of each method. The distance field finishes after the eight training images.
const N_STEPS: &str = "24";

/// The JSON lines of a successful training.
fn trained(folder: &Path, args: &[&str]) -> Vec<Value> {
    let args = [&["train", "data", "--json"], args].concat();
    let output = fieldrig(folder, &args);
    assert!(
        output.status.success(),
        "{args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    let stdout = String::from_utf8(output.stdout).expect("stdout is UTF-8");
    stdout
        .lines()
        .map(|line| serde_json::from_str(line).expect("one JSON object per line"))
        .collect()
}

fn done_events(printed: &[Value]) -> Vec<&Value> {
    printed
        .iter()
        .filter(|event| event["event"] == "done")
        .collect()
}

fn assert_fails_with(folder: &Path, args: &[&str], words: &[&str]) {
    assert_one_error(args, &fieldrig(folder, args), 2, words);
}

#[test]
fn several_methods_equal_single_trainings() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    let common = ["--steps", N_STEPS, "--seed", "3", "--refine", "image-poses"];
    let all = [
        "--method",
        "tsdf,splat,nerf",
        "--max-splats",
        "500",
        "--out",
        "all",
    ];
    let together = trained(folder, &[&common[..], &all].concat());
    let together = done_events(&together);
    let methods: Vec<&str> = together
        .iter()
        .filter_map(|done| done["method"].as_str())
        .collect();
    assert_eq!(methods, ["tsdf", "splat", "nerf"]);
    for done in &together {
        let method = done["method"].as_str().expect("a method");
        let caps: &[&str] = if method == "splat" {
            &["--max-splats", "500"]
        } else {
            &[]
        };
        let alone = trained(
            folder,
            &[&common[..], caps, &["--method", method, "--out", method]].concat(),
        );
        let alone = done_events(&alone)[0];
        for key in ["checkpoint_sha256", "steps", "psnr", "primitives", "bytes"] {
            assert_eq!(done[key], alone[key], "{method}: {key}");
        }
        assert_eq!(done["out"], json!(format!("all/{method}")));
        // The logs differ only in their first line, which contains the caps. Only splats have caps.
        let [log, log_alone] = ["all/", ""].map(|run| {
            let log =
                std::fs::read_to_string(folder.join(run).join(method).join("decisions.jsonl"))
                    .expect("a log");
            log.lines().skip(1).map(str::to_owned).collect::<Vec<_>>()
        });
        assert!(!log.is_empty() && log == log_alone, "{method}: {log:?}");
    }
    assert_eq!(
        together[0]["steps"],
        json!(8),
        "the distance field has fused all images"
    );

    check_resume_of_one_method(folder, together[1]);
    check_mesh_export(folder);
    let small = [
        "train",
        "data",
        "--method",
        "tsdf,splat",
        "--max-bytes",
        "1000000",
        "--out",
        "small",
    ];
    assert_fails_with(
        folder,
        &small,
        &["the smallest distance field takes 2629632 bytes"],
    );
    assert!(
        !folder.join("small").exists(),
        "a rejected command leaves no files behind"
    );
    assert_fails_with(
        folder,
        &["eval", "all", "data"],
        &["all/splat or all/tsdf or all/nerf"],
    );
    assert_fails_with(
        folder,
        &["train", "data", "--out", "all"],
        &["already contains a model", "splat/model.json"],
    );
}

/// Checks that the folder of each method can be used like the folder of a single run.
fn check_resume_of_one_method(folder: &Path, splat: &Value) {
    let again = trained(
        folder,
        &[
            "--replay-decisions",
            "all/splat/decisions.jsonl",
            "--out",
            "again",
        ],
    );
    assert_eq!(
        done_events(&again)[0]["checkpoint_sha256"],
        splat["checkpoint_sha256"]
    );
    let on = trained(
        folder,
        &["--resume", "all/splat", "--steps", N_STEPS, "--out", "on"],
    );
    assert_eq!(
        done_events(&on)[0]["checkpoint_sha256"],
        splat["checkpoint_sha256"]
    );
    assert_fails_with(
        folder,
        &["train", "data", "--resume", "all"],
        &["all/splat or all/tsdf or all/nerf"],
    );
    let evaluated = fieldrig(folder, &["eval", "all/splat", "data", "--json"]);
    let evaluated: Value = serde_json::from_slice(&evaluated.stdout).expect("a JSON object");
    assert_eq!(evaluated["psnr"], splat["psnr"]);
}

/// Checks that distance fields export their mesh, whole or simplified, and that other models have
/// no mesh.
fn check_mesh_export(folder: &Path) {
    let export = |to: &str, more: &[&str], out: &str| {
        let output = fieldrig(
            folder,
            &[&["export", "all/tsdf", "--to", to, "--out", out], more].concat(),
        );
        assert!(
            output.status.success(),
            "{}",
            String::from_utf8_lossy(&output.stderr)
        );
        std::fs::read(folder.join(out)).expect("a mesh")
    };
    for to in ["ply", "glb"] {
        let saved =
            std::fs::read(folder.join(format!("all/tsdf/mesh.{to}"))).expect("the saved mesh");
        assert!(
            export(to, &[], &format!("whole.{to}")) == saved,
            "{to}: the same mesh"
        );
        let coarse = export(to, &["--cell-m", "0.1"], &format!("coarse.{to}"));
        assert!(
            coarse.len() < saved.len() / 4,
            "{to}: {} of {} bytes",
            coarse.len(),
            saved.len()
        );
    }
    assert_fails_with(
        folder,
        &["export", "all/tsdf", "--to", "spz", "--out", "a.spz"],
        &["a distance field cannot be exported as spz, only as glb or ply"],
    );
    assert_fails_with(
        folder,
        &["export", "all/tsdf", "--to", "glb", "--out", "whole.glb"],
        &["the file exists"],
    );
    assert_fails_with(
        folder,
        &["export", "all/tsdf", "--to", "glb", "--out", "a.ply"],
        &["must end in .glb"],
    );
    assert_fails_with(
        folder,
        &[
            "export", "all/tsdf", "--to", "glb", "--out", "a.glb", "--cell-m", "0",
        ],
        &["--cell-m"],
    );
    assert_fails_with(
        folder,
        &["export", "all/nerf", "--to", "glb", "--out", "a.glb"],
        &["a neural field cannot be exported"],
    );
    assert_fails_with(
        folder,
        &["export", "all", "--to", "glb", "--out", "a.glb"],
        &["all/splat or all/tsdf or all/nerf"],
    );
}

#[test]
fn several_methods_share_time_and_one_clock() {
    /// Methods share the time equally, but steps of splats become longer. On a slow machine, the
    /// last time slice is also a large part of the time.
    const MAX_TIME_RATIO: f64 = 3.0;
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    let args = [
        "--seconds",
        "2.1",
        "--max-splats",
        "500",
        "--method",
        "splat,nerf",
        "--out",
        "both",
    ];
    let printed = trained(folder, &args);
    let evals = |method: &str| -> Vec<&Value> {
        printed
            .iter()
            .filter(|event| event["event"] == "eval" && event["method"] == method)
            .collect()
    };
    let number = |event: &Value, key: &str| {
        event[key]
            .as_f64()
            .unwrap_or_else(|| panic!("no {key} in {event}"))
    };
    let (splat, nerf) = (evals("splat"), evals("nerf"));
    // Evaluations of a slow method are left out if they take too long.
    assert!(
        splat.len() >= 3 && (1..=splat.len()).contains(&nerf.len()),
        "{printed:?}"
    );
    let at_the_same_time = |of_nerf: &&Value| -> &Value {
        let gap =
            |of_splat: &&&Value| (number(of_splat, "seconds") - number(of_nerf, "seconds")).abs();
        let nearest = splat
            .iter()
            .min_by(|one, other| gap(one).total_cmp(&gap(other)))
            .expect("three");
        assert!(
            gap(&nearest) < 0.02,
            "at the same evaluation point: {nearest}, {of_nerf}"
        );
        nearest
    };
    let splat: Vec<&Value> = nerf.iter().map(at_the_same_time).collect();
    let millis = |evals: &[&Value]| {
        let last = evals.last().expect("evaluations");
        number(last, "step") * number(last, "step_millis")
    };
    let time_ratio = millis(&splat) / millis(&nerf);
    assert!(
        (1.0 / MAX_TIME_RATIO..MAX_TIME_RATIO).contains(&time_ratio),
        "splats had {time_ratio:.2} times as much time: {printed:?}"
    );
}

#[test]
fn invalid_methods_give_one_error() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    for (methods, word) in [
        ("splat,mesh", "\"mesh\""),
        ("tsdf,splat,tsdf", "tsdf is listed twice"),
        ("", "splat, tsdf or nerf"),
    ] {
        assert_fails_with(
            folder,
            &["train", "data", "--method", methods],
            &["--method", word],
        );
        assert_fails_with(
            folder,
            &["run", "rig.toml", "--method", methods],
            &["--method", word],
        );
    }
    assert_fails_with(
        folder,
        &["train", "data", "--resume", "a", "--method", "splat,tsdf"],
        &["--method", "--resume"],
    );
}
