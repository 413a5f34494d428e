//! Tests `fieldrig metrics` and `fieldrig export` as users run them.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

use image::{ExtendedColorType, RgbaImage};
use model_files::splat::arrays::SplatArrays;
use model_files::splat::cloud::synthetic_cloud;
use model_files::splat::{ply, spz};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn fieldrig(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command
        .env_remove("FIELDRIG_LPIPS_WEIGHTS")
        .args(arguments)
        .output()
        .unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The single line of JSON that a command printed.
fn json_of(output: &Output) -> Value {
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The error message of a command that failed with `code`.
fn error_message(output: &Output, code: i32) -> String {
    let stderr_text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(
        (output.status.code(), output.stdout.len()),
        (Some(code), 0),
        "{stderr_text}"
    );
    stderr_text
}

fn picture(folder: &Path, name: &str, side: u32, level: u8) -> PathBuf {
    let path = folder.join(name);
    let shade = |x: u32, y: u32| u8::try_from((7 * x + 13 * y) % 100).unwrap();
    RgbaImage::from_fn(side, side, |x, y| {
        image::Rgba([shade(x, y) + level, shade(y, x), 9, 255])
    })
    .save(&path)
    .unwrap();
    path
}

#[test]
fn metrics_are_one_json_object() {
    let folder = tempfile::tempdir().unwrap();
    let (a, b) = (
        picture(folder.path(), "a.png", 20, 6),
        picture(folder.path(), "b.png", 20, 0),
    );
    let scores = json_of(&fieldrig(&["metrics", text(&a), text(&b), "--json"]));
    // One of three color channels differs by 6 everywhere.
    let expected_db = 10.0 * (255.0_f64.powi(2) / 12.0).log10();
    assert!(
        (scores["psnr"].as_f64().unwrap() - expected_db).abs() < 1e-9,
        "{scores}"
    );
    assert!(
        (0.5..1.0).contains(&scores["ssim"].as_f64().unwrap()),
        "{scores}"
    );
    assert!(
        scores["lpips"].is_null() && scores["depth_rmse_m"].is_null(),
        "{scores}"
    );
    let text_output = fieldrig(&["metrics", text(&a), text(&b)]);
    assert!(
        String::from_utf8_lossy(&text_output.stdout).starts_with("PSNR 37.339 dB  SSIM 0."),
        "{text_output:?}"
    );
}

#[test]
fn metrics_match_the_reference_values() {
    let Some(folder) = test_support::data_folder("metrics") else {
        return;
    };
    let [a, b, weights] = [
        "fox_a.png",
        "fox_b_noise.png",
        "lpips_squeeze_v0.1.safetensors",
    ]
    .map(|name| folder.join(name));
    let scores = json_of(&fieldrig(&[
        "metrics",
        text(&a),
        text(&b),
        "--lpips-weights",
        text(&weights),
        "--json",
    ]));
    let mut expected_scores = vec![
        ("psnr", 26.664_521_996, 1e-6),
        ("ssim", 0.566_104_874, 1e-4),
    ];
    if cfg!(feature = "lpips") {
        expected_scores.push(("lpips", 0.270_175_07, 1e-4));
    }
    for (key, expected, tolerance) in expected_scores {
        assert!(
            (scores[key].as_f64().unwrap() - expected).abs() < tolerance,
            "{key}: {scores}"
        );
    }
}

#[test]
#[cfg(not(feature = "lpips"))]
fn lpips_is_omitted_with_a_warning_if_not_built() {
    let folder = tempfile::tempdir().unwrap();
    let (a, b) = (
        picture(folder.path(), "a.png", 80, 6),
        picture(folder.path(), "b.png", 80, 0),
    );
    let output = fieldrig(&[
        "metrics",
        text(&a),
        text(&b),
        "--lpips-weights",
        "weights.safetensors",
        "--json",
    ]);
    assert!(json_of(&output)["lpips"].is_null());
    let warnings = String::from_utf8_lossy(&output.stderr);
    assert!(
        warnings.contains("no LPIPS: this program was built without LPIPS (cargo feature `lpips`)"),
        "{warnings}"
    );
}

#[test]
fn metrics_of_depth_images_are_in_meters() {
    let folder = tempfile::tempdir().unwrap();
    let save = |name: &str, counts: [u16; 4]| {
        let bytes: Vec<u8> = counts
            .iter()
            .flat_map(|count| count.to_ne_bytes())
            .collect();
        let path = folder.path().join(name);
        image::save_buffer(&path, &bytes, 2, 2, ExtendedColorType::L16).unwrap();
        path
    };
    let (a, b) = (
        save("a.png", [1000, 2000, 0, 3000]),
        save("b.png", [1010, 1990, 500, 0]),
    );
    let scores = json_of(&fieldrig(&["metrics", text(&a), text(&b), "--json"]));
    assert!(
        (scores["depth_rmse_m"].as_f64().unwrap() - 0.01).abs() < 1e-6 && scores["psnr"].is_null(),
        "{scores}"
    );
}

#[test]
fn incomparable_pictures_give_one_error() {
    let folder = tempfile::tempdir().unwrap();
    let (a, b) = (
        picture(folder.path(), "a.png", 20, 0),
        picture(folder.path(), "b.png", 30, 0),
    );
    let stderr_text = error_message(&fieldrig(&["metrics", text(&a), text(&b)]), 1);
    assert!(
        stderr_text.contains("a.png is 20x20 pixels")
            && stderr_text.contains("the images must have the same size"),
        "{stderr_text}"
    );
    std::fs::write(&b, b"not a picture").unwrap();
    assert!(error_message(&fieldrig(&["metrics", text(&a), text(&b)]), 1).contains("b.png"));
    let small = picture(folder.path(), "small.png", 10, 0);
    let stderr_text = error_message(&fieldrig(&["metrics", text(&small), text(&small)]), 1);
    assert!(
        stderr_text.contains("SSIM needs pictures of at least 11x11 pixels"),
        "{stderr_text}"
    );
}

#[test]
fn model_is_exported_as_ply() {
    let folder = tempfile::tempdir().unwrap();
    let (model, out) = (folder.path().join("model"), folder.path().join("scene.ply"));
    std::fs::create_dir(&model).unwrap();
    let splats = synthetic_cloud(20, 1);
    ply::write(&model.join("splats.ply"), &splats).unwrap();
    let export = ["export", text(&model), "--to", "ply", "--out", text(&out)];
    let output = fieldrig(&export);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(ply::read(&out).unwrap(), splats);

    let stderr_text = error_message(&fieldrig(&export), 2);
    assert!(
        stderr_text.contains("scene.ply: the file exists"),
        "{stderr_text}"
    );
    let out = folder.path().join("other.ply");
    let stderr_text = error_message(
        &fieldrig(&["export", text(&model), "--to", "spz", "--out", text(&out)]),
        2,
    );
    assert!(stderr_text.contains("must end in .spz"), "{stderr_text}");
    let glb = folder.path().join("mesh.glb");
    let stderr_text = error_message(
        &fieldrig(&["export", text(&model), "--to", "glb", "--out", text(&glb)]),
        2,
    );
    assert!(
        stderr_text.contains("a splat model cannot be exported as glb, only as spz or ply"),
        "{stderr_text}"
    );
    let stderr_text = error_message(
        &fieldrig(&[
            "export",
            text(&model),
            "--to",
            "ply",
            "--cell-m",
            "0.1",
            "--out",
            text(&out),
        ]),
        2,
    );
    assert!(
        stderr_text.contains("--cell-m") && stderr_text.contains("has no mesh"),
        "{stderr_text}"
    );
    let stderr_text = error_message(
        &fieldrig(&[
            "export",
            text(&model),
            "--to",
            "nerfstudio",
            "--out",
            text(&out),
        ]),
        2,
    );
    assert!(
        stderr_text.contains("nerfstudio is exported from a recording"),
        "{stderr_text}"
    );
    let nothing = folder.path().join("nothing");
    let stderr_text = error_message(
        &fieldrig(&["export", text(&nothing), "--to", "ply", "--out", text(&out)]),
        2,
    );
    assert!(
        stderr_text.contains("nothing does not exist"),
        "{stderr_text}"
    );
    let stderr_text = error_message(
        &fieldrig(&[
            "export",
            text(folder.path()),
            "--to",
            "ply",
            "--out",
            text(&out),
        ]),
        2,
    );
    assert!(
        stderr_text.contains("not a model folder, a splat file or a recording"),
        "{stderr_text}"
    );
    let other = folder.path().join("other.bin");
    std::fs::write(&other, b"neither").unwrap();
    let stderr_text = error_message(
        &fieldrig(&[
            "export",
            text(&other),
            "--to",
            "nerfstudio",
            "--out",
            text(&nothing),
        ]),
        1,
    );
    assert!(stderr_text.contains("is not a recording"), "{stderr_text}");
}

#[test]
fn model_round_trips_through_spz() {
    let folder = tempfile::tempdir().unwrap();
    let [ply_file, spz_file, again] =
        ["scene.ply", "scene.spz", "again.ply"].map(|name| folder.path().join(name));
    ply::write(&ply_file, &synthetic_cloud(200, 1)).unwrap();
    let output = fieldrig(&[
        "export",
        text(&ply_file),
        "--to",
        "spz",
        "--out",
        text(&spz_file),
    ]);
    assert!(output.status.success(), "{output:?}");
    let bytes = |path: &Path| std::fs::metadata(path).unwrap().len();
    assert!(
        4 * bytes(&spz_file) < bytes(&ply_file),
        "{} of {} bytes",
        bytes(&spz_file),
        bytes(&ply_file)
    );
    let output = fieldrig(&[
        "export",
        text(&spz_file),
        "--to",
        "ply",
        "--out",
        text(&again),
    ]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(ply::read(&again).unwrap(), spz::read(&spz_file).unwrap());

    let whole = std::fs::read(&spz_file).unwrap();
    std::fs::write(&spz_file, &whole[..whole.len() / 2]).unwrap();
    let again = folder.path().join("cut.ply");
    let stderr_text = error_message(
        &fieldrig(&[
            "export",
            text(&spz_file),
            "--to",
            "ply",
            "--out",
            text(&again),
        ]),
        1,
    );
    assert!(
        stderr_text.contains("scene.spz") && stderr_text.contains("truncated"),
        "{stderr_text}"
    );
}

#[test]
fn absurd_splats_and_empty_models_are_reported() {
    let folder = tempfile::tempdir().unwrap();
    let [absurd_file, empty_file, out] =
        ["absurd.ply", "empty.ply", "out.ply"].map(|name| folder.path().join(name));
    let mut absurd = synthetic_cloud(20, 1);
    absurd.log_scales[7][0] = 200.0;
    ply::write(&absurd_file, &absurd).unwrap();
    let output = fieldrig(&[
        "export",
        text(&absurd_file),
        "--to",
        "ply",
        "--out",
        text(&out),
    ]);
    assert!(output.status.success(), "{output:?}");
    let stderr_text = String::from_utf8_lossy(&output.stderr);
    let expected = "left out 1 of 20 splats with invalid numbers; the first has index 7: a standard deviation exceeds";
    assert!(
        stderr_text.contains("absurd.ply") && stderr_text.contains(expected),
        "{stderr_text}"
    );
    assert_eq!(ply::read(&out).unwrap().n_splats(), 19);

    ply::write(&empty_file, &SplatArrays::default()).unwrap();
    let pictures = folder.path().join("pictures");
    let pose = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1";
    let view = ["--pose", pose, "--size", "16x16", "--out", text(&pictures)];
    let output = fieldrig(&[&["render", text(&empty_file)][..], &view].concat());
    assert!(
        output.status.success() && pictures.join("00000.png").is_file(),
        "{output:?}"
    );
    let stderr_text = String::from_utf8_lossy(&output.stderr);
    let expected = "empty.ply contains no splats: its pictures show only the background";
    assert!(stderr_text.contains(expected), "{stderr_text}");
    assert!(
        !stderr_text.contains("the model covers"),
        "one warning is enough: {stderr_text}"
    );
}
