//! Tests `fieldrig train --depth-from`: images without depth get depth rendered from a saved model.

use crate::wall;
use crate::wall::fieldrig;
use serde_json::Value;
use std::path::Path;
use std::process::Output;

const N_STEPS: &str = "24";
/// Minimum gain from rendered depth after these few steps, dB.
const MIN_GAIN_DB: f64 = 2.0;
/// The measured error is 0.2 mm, because splats keep their initial depth.
const MAX_DEPTH_ERROR_M: f64 = 2e-3;

fn train(folder: &Path, args: &[&str]) -> Output {
    fieldrig(folder, &[&["train", "--json"], args].concat())
}

/// The final event of a successful training.
fn done(folder: &Path, args: &[&str]) -> Value {
    let output = train(folder, args);
    assert!(
        output.status.success(),
        "{args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    let printed = String::from_utf8(output.stdout).expect("stdout is UTF-8");
    serde_json::from_str(printed.lines().last().expect("an end")).expect("a JSON object")
}

fn assert_fails_with(folder: &Path, args: &[&str], code: i32, words: &str) {
    let output = train(folder, &[args, &["--out", "x"]].concat());
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{args:?}: {printed}");
    assert!(
        printed
            .lines()
            .any(|line| line.starts_with("error: ") && line.contains(words)),
        "{args:?}: {printed}"
    );
    assert!(
        !folder.join("x").exists(),
        "a rejected command leaves no files behind"
    );
}

#[test]
fn rendered_depth_improves_training_and_is_repeatable() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    wall::write(&folder.join("measured"), true, 0.0);
    wall::write(&folder.join("color"), false, 0.0);
    wall::write(&folder.join("elsewhere"), false, 50.0);
    done(
        folder,
        &[
            "measured", "--method", "tsdf", "--refine", "none", "--out", "field",
        ],
    );

    let settings = [
        "--plan-steps",
        N_STEPS,
        "--seed",
        "3",
        "--max-splats",
        "2000",
        "--refine",
        "none",
    ];
    let splats = |data: &str, steps: &str, more: &[&str]| {
        done(
            folder,
            &[&[data, "--steps", steps], &settings[..], more].concat(),
        )
    };
    let from_field = ["--depth-from", "field"];
    let with = |more: &[&'static str]| [&from_field[..], more].concat();
    let bare = splats("color", N_STEPS, &["--out", "bare"]);
    let rendered = splats("color", N_STEPS, &with(&["--out", "drawn"]));
    let psnr = |done: &Value| done["psnr"].as_f64().expect("a score");
    assert!(
        psnr(&rendered) > psnr(&bare) + MIN_GAIN_DB,
        "{bare} {rendered}"
    );
    let report = std::fs::read(folder.join("drawn/report.json")).expect("a report");
    let report: Value = serde_json::from_slice(&report).expect("JSON");
    assert_eq!(
        report["rendered_depth"]["n_images"], 8,
        "test images get no rendered depth"
    );
    assert!(
        report["rendered_depth"]["rendered_frac"].as_f64() > Some(0.9),
        "{}",
        report["rendered_depth"]
    );

    // The flag has no effect if all images have measured depth.
    let measured = splats("measured", N_STEPS, &["--out", "measured splats"]);
    let both = splats("measured", N_STEPS, &with(&["--out", "both"]));
    assert_eq!(both["checkpoint_sha256"], measured["checkpoint_sha256"]);

    let sha256 = &rendered["checkpoint_sha256"];
    assert_eq!(
        splats("color", N_STEPS, &with(&["--out", "twice"]))["checkpoint_sha256"],
        *sha256
    );
    splats("color", "12", &with(&["--out", "half"]));
    let resume = ["color", "--resume", "half", "--steps", N_STEPS];
    let whole = done(folder, &[&resume[..], &with(&["--out", "whole"])].concat());
    assert_eq!(
        whole["checkpoint_sha256"], *sha256,
        "the resumed run gives a different model"
    );
    let replay = ["color", "--replay-decisions", "drawn/decisions.jsonl"];
    let repeated = done(
        folder,
        &[&replay[..], &with(&["--out", "repeated"])].concat(),
    );
    assert_eq!(
        repeated["checkpoint_sha256"], *sha256,
        "the log gives a different model"
    );

    // A checkpoint names the model, so a resumed run finds it without a flag. A decision log
    // contains only its hash.
    let found = done(folder, &[&resume[..], &["--out", "found"]].concat());
    assert_eq!(
        found["checkpoint_sha256"], *sha256,
        "resumed without --depth-from"
    );
    assert_fails_with(folder, &replay, 2, "give that model with --depth-from");
    for again in [&resume[..], &replay] {
        let drawn = [again, &["--depth-from", "drawn"]].concat();
        assert_fails_with(folder, &drawn, 2, "the model given with --depth-from has");
    }
    let bare = ["color", "--resume", "bare", "--depth-from", "field"];
    assert_fails_with(folder, &bare, 2, "remove the flag");
    assert_fails_with(
        folder,
        &["elsewhere", "--depth-from", "field"],
        4,
        "the model is not visible in any image",
    );
    assert_fails_with(
        folder,
        &["color", "--depth-from", "measured"],
        2,
        "measured contains no model",
    );
    assert_fails_with(
        folder,
        &["color", "--depth-from", "field/mesh.ply"],
        2,
        "--depth-from: field/mesh.ply is not a file of splats",
    );
    assert_fails_with(
        folder,
        &["color", "--method", "tsdf"],
        4,
        "no training image has depth",
    );

    // With depth rendered from splats, images without depth give a mesh.
    done(
        folder,
        &[
            "color",
            "--method",
            "tsdf",
            "--depth-from",
            "drawn",
            "--out",
            "mesh",
        ],
    );
    let evaluated = fieldrig(folder, &["eval", "mesh", "measured", "--json"]).stdout;
    let evaluated: Value = serde_json::from_slice(&evaluated).expect("a JSON object");
    let elsewhere = fieldrig(folder, &["eval", "mesh", "elsewhere"]).stderr;
    let elsewhere = String::from_utf8(elsewhere).expect("stderr is UTF-8");
    assert!(
        elsewhere.contains("the model covers 0.0 % of 2 views; check that model and"),
        "{elsewhere}"
    );
    assert!(
        evaluated["depth_rmse_m"]
            .as_f64()
            .is_some_and(|error_m| error_m < MAX_DEPTH_ERROR_M),
        "{evaluated}"
    );
}
