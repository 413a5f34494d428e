//! Tests `fieldrig bench curve`, `budget`, `ablation` and `stability` as users run them, on a scene
//! of a few tiny photos.

use crate::command::assert_one_error;
#[cfg(feature = "sim")]
use crate::small_rig::{self, Pace};
use image::RgbImage;
use serde_json::{Value, json};
use std::path::Path;
use std::process::{Command, Output};

/// Photos of the scene; two of them are test images.
const N_PHOTOS: u32 = 12;
const SIZE_PX: [u32; 2] = [32, 24];

/// Writes a nerfstudio folder: a camera slides along a colorful wall, 1 m away from it.
fn scene(folder: &Path) {
    let (mut frames, focal_px) = (Vec::new(), 30.0);
    for ix in 0..N_PHOTOS {
        let x_m = 0.05 * f64::from(ix);
        let color = |u: u32, v: u32| {
            let (x, y) = (
                x_m + (f64::from(u) - 15.5) / focal_px,
                (f64::from(v) - 11.5) / focal_px,
            );
            #[expect(clippy::cast_possible_truncation, reason = "27 to 227")]
            let wave = |phase: f64| {
                (127.0 + 100.0 * (8.0 * x + phase).sin() * (7.0 * y + phase).cos()) as u8
            };
            image::Rgb([wave(0.0), wave(1.0), wave(2.0)])
        };
        let name = format!("{ix:02}.png");
        RgbImage::from_fn(SIZE_PX[0], SIZE_PX[1], color)
            .save(folder.join(&name))
            .expect("the disk has space");
        // An OpenGL camera that looks along -z, as in nerfstudio.
        let rows = [
            [1.0, 0.0, 0.0, x_m],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 1.0],
            [0.0, 0.0, 0.0, 1.0],
        ];
        frames.push(json!({ "file_path": name, "transform_matrix": rows }));
    }
    let [w, h] = SIZE_PX;
    let scene = json!({ "fl_x": focal_px, "fl_y": focal_px, "cx": 16.0, "cy": 12.0, "w": w, "h": h, "frames": frames });
    std::fs::write(folder.join("transforms.json"), scene.to_string()).expect("the disk has space");
}

fn bench(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command
        .current_dir(folder)
        .env_remove("FIELDRIG_LPIPS_WEIGHTS")
        .arg("bench")
        .args(args);
    command.output().expect("fieldrig starts")
}

/// The JSON lines of a successful bench.
fn events(folder: &Path, args: &[&str]) -> Vec<Value> {
    let output = bench(folder, args);
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

/// Asserts that a bench fails with one error message that contains all `words`.
fn assert_fails_with(folder: &Path, args: &[&str], code: i32, words: &[&str]) {
    assert_one_error(args, &bench(folder, args), code, words);
}

fn assert_chart(folder: &Path, name: &str) {
    let svg = std::fs::read_to_string(folder.join(format!("{name}.svg"))).expect("a drawing");
    assert!(
        svg.contains("test PSNR, dB") || svg.contains("gain, dB"),
        "{svg}"
    );
    assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    let picture = image::open(folder.join(format!("{name}.png")))
        .expect("a picture")
        .into_rgb8();
    let n_inked = picture.pixels().filter(|pixel| pixel.0 != [255; 3]).count();
    assert!(
        picture.width() > 1000 && n_inked > 10_000,
        "{name}: {n_inked} pixels drawn"
    );
}

#[test]
fn kernel_bench_reports_every_variant() {
    let folder = tempfile::tempdir().expect("a folder");
    let args = [
        "kernels",
        "--size",
        "64x48",
        "--splats",
        "2000",
        "--repeats",
        "1",
        "--inside",
        "--json",
    ];
    let row = &events(folder.path(), &args)[0];
    for column in ["render_millis", "step_millis", "step_visible_millis"] {
        assert!(row[column].as_f64() > Some(0.0), "{column}: {row}");
    }
    assert!(
        row["n_splats_in_view"]
            .as_u64()
            .is_some_and(|n| (50..1500).contains(&n)),
        "only some of the splats are visible: {row}"
    );
    let plain = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args([&["bench"], &args[..]].concat())
        .env("FIELDRIG_GPU_FEATURES", "none")
        .output()
        .expect("fieldrig starts");
    let row: Value = serde_json::from_slice(&plain.stdout).expect("a JSON object");
    assert!(row["step_visible_millis"].as_f64() > Some(0.0), "{row}");
}

#[test]
fn steering_bench_reports_each_fault_and_writes_a_chart() {
    let folder = tempfile::tempdir().expect("a folder");
    let args = ["steering", "--arms", "simulated", "--trials", "1"];
    let faults = ["--faults", "released,page-frozen", "--json"];
    let short = ["--tracking-seconds", "0", "--poses", "20", "--grips", "2"];
    let events = events(folder.path(), &[&args[..], &faults, &short].concat());
    let [released, frozen, done] = &events[..] else {
        panic!("two faults and the results: {events:?}");
    };
    for (event, fault) in [(released, "released"), (frozen, "page-frozen")] {
        assert_eq!(event["event"], "fault", "{event}");
        assert_eq!(event["row"]["fault"], fault, "{event}");
        assert_eq!(event["row"]["n_exceeded"], 0, "{event}");
    }
    assert_eq!(done["findings"]["grips"]["n_exceeded"], 0, "{done}");
    let rates = done["findings"]["inverse"].as_array().expect("a list");
    assert!(rates.len() > 3, "{done}");
    let out = folder.path().join("bench-steering");
    assert!(out.join("steering-faults.svg").is_file());

    let unknown = ["steering", "--faults", "weather"];
    assert_fails_with(folder.path(), &unknown, 2, &["--faults", "weather"]);
}

#[cfg(feature = "sim")]
#[test]
fn steering_bench_kills_the_program_that_drives_a_base() {
    let folder = tempfile::tempdir().expect("a folder");
    let args = ["steering", "--arms", "udp-base", "--trials", "1", "--json"];
    let rest = [
        "--faults",
        "released,program-killed",
        "--poses",
        "0",
        "--grips",
        "0",
    ];
    let events = events(folder.path(), &[&args[..], &rest].concat());
    let [released, killed, _] = &events[..] else {
        panic!("two faults and the results: {events:?}");
    };
    assert_eq!(released["row"]["n_exceeded"], 0, "{released}");
    let row = &killed["row"];
    assert_eq!(row["fault"], "program-killed", "{killed}");
    // On a busy computer, the base may never have moved.
    if row["n_trials"] == 1 {
        assert_eq!(
            row["n_not_at_rest"], 0,
            "its controller stops the base: {killed}"
        );
        // The limits of braking predict nothing, because the program cannot brake.
        assert!(row["predicted"]["worst_millis"].is_null(), "{killed}");
    }
}

#[cfg(feature = "sim")]
#[test]
fn steering_bench_steers_a_run_to_views_that_its_scan_never_had() {
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write(folder.path(), Pace::RealTime);
    let views = ["steering", "--views", "2", "--views-rig", "rig.toml"];
    let slow = ["--views-round-trip", "150", "--trials", "0", "--json"];
    let rest = ["--tracking-seconds", "0", "--poses", "0", "--grips", "0"];
    let events = events(folder.path(), &[&views[..], &slow, &rest].concat());
    let views = events[0]["findings"]["views"].as_array().expect("a list");
    assert_eq!(views.len(), 2, "{events:?}");
    for view in views {
        assert_eq!(
            view["is_previewed"], true,
            "150 ms are too long to follow a hand: {view}"
        );
    }
    let arrived: Vec<_> = views
        .iter()
        .filter(|view| view["arrived_secs"].is_f64())
        .collect();
    assert!(!arrived.is_empty(), "{views:?}");
    // How much better the picture is after 20 s depends on the computer.
    for view in arrived {
        let db = |name: &str| view[name].as_f64();
        if let [Some(before), Some(after)] = [db("before_db"), db("after_db")] {
            assert!(after > before, "{view}");
        }
    }
}

/// Checks that `--scan` reproduces the counts of a scan (docs/benchmarks/README.md), with as many
/// splats per pixel as in a scan.
#[test]
fn kernel_bench_of_a_scan_has_uneven_lists() {
    let folder = tempfile::tempdir().expect("a folder");
    let row = &events(
        folder.path(),
        &[
            "kernels",
            "--scan",
            "--size",
            "160x120",
            "--splats",
            "25000",
            "--repeats",
            "1",
            "--json",
        ],
    )[0];
    let count = |name: &str| {
        row[name]
            .as_f64()
            .unwrap_or_else(|| panic!("no {name} in {row}"))
    };
    let mean = count("n_intersections") / count("n_tiles");
    assert!((400.0..900.0).contains(&mean), "{row}");
    let visible_frac = count("n_visible") / count("n_intersections");
    assert!((0.9..=1.0).contains(&visible_frac), "{visible_frac}: {row}");
    assert!(count("longest_list") > 2.0 * mean, "{row}");
    assert_eq!(count("largest_splat"), count("n_tiles"));
}

#[test]
fn curve_bench_draws_peers_and_resumes() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    scene(folder);
    let peer = json!({ "rows": [{ "seconds": 0.25, "psnr": 12.0, "n": 50 }, { "seconds": 1.0, "psnr": 26.0, "n": 90 }] });
    std::fs::write(folder.join("other.json"), peer.to_string()).expect("the disk has space");
    let args = [
        "curve",
        ".",
        "--seconds",
        "0.6",
        "--seeds",
        "2",
        "--max-splats",
        "500",
        "--peer",
        "other.json",
        "--out",
        "c",
    ];
    let printed = events(folder, &[&args[..], &["--json"]].concat());
    assert_eq!(
        printed
            .iter()
            .filter(|event| event["event"] == "run")
            .count(),
        2
    );
    let lines = printed[2]["findings"]["lines"]
        .as_array()
        .expect("lines")
        .clone();
    assert_eq!((lines.len(), &lines[1]["label"]), (2, &json!("other")));
    assert!(
        lines[0]["points"]
            .as_array()
            .is_some_and(|points| !points.is_empty()),
        "{}",
        lines[0]
    );
    assert_eq!(lines[0]["summary"]["n_runs"], 2);
    let reached = &lines[1]["summary"]["seconds_to"][0];
    assert!(
        reached["seconds"]
            .as_f64()
            .is_some_and(|secs| (0.8..1.0).contains(&secs)),
        "{reached}"
    );
    assert_chart(&folder.join("c"), "curve");
    let page = std::fs::read_to_string(folder.join("c/curve.html")).expect("a page");
    assert!(page.contains("<svg ") && page.contains("to 28 dB"));

    // Only the removed run is repeated, not the finished one.
    let runs = std::fs::read_dir(folder.join("c/bench-runs")).expect("runs");
    let first = runs
        .map(|run| run.expect("a run").path())
        .min()
        .expect("a run");
    std::fs::remove_file(first).expect("removed");
    let again = events(folder, &[&args[..], &["--json"]].concat());
    assert_eq!(
        [&again[0]["cached"], &again[1]["cached"]],
        [&json!(false), &json!(true)]
    );
    assert_eq!(again[1]["end"], printed[1]["end"]);
    let changed = [
        "curve",
        ".",
        "--seconds",
        "0.6",
        "--seeds",
        "2",
        "--max-splats",
        "400",
        "--out",
        "c",
    ];
    assert_fails_with(folder, &changed, 2, &["max_splats", "--out c"]);
}

/// Adds depth images of 1 m everywhere, the distance of the wall of [`scene`].
fn add_depth(folder: &Path) {
    let file = folder.join("transforms.json");
    let mut scene: Value =
        serde_json::from_slice(&std::fs::read(&file).expect("a scene")).expect("JSON");
    let [width, height] = SIZE_PX;
    for frame in scene["frames"].as_array_mut().expect("frames") {
        let name = format!("depth_{}", frame["file_path"].as_str().expect("a name"));
        let depth = image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(
            width,
            height,
            image::Luma([1000]),
        );
        depth.save(folder.join(&name)).expect("the disk has space");
        frame["depth_file_path"] = json!(name);
    }
    std::fs::write(file, scene.to_string()).expect("the disk has space");
}

#[test]
fn curve_bench_skips_methods_without_sufficient_data() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    for data in ["deep", "flat"] {
        std::fs::create_dir(folder.join(data)).expect("the disk has space");
        scene(&folder.join(data));
    }
    add_depth(&folder.join("deep"));
    let one = [
        "curve",
        "deep",
        "flat",
        "--seconds",
        "0.4",
        "--seeds",
        "1",
        "--max-splats",
        "300",
        "--out",
        "c",
    ];
    let printed = events(
        folder,
        &[&one[..], &["--method", "splat", "--json"]].concat(),
    );
    assert_eq!(
        printed
            .iter()
            .filter(|event| event["event"] == "run")
            .count(),
        2
    );
    // Adding methods in the same folder does not repeat finished runs.
    let printed = events(
        folder,
        &[&one[..], &["--method", "splat,tsdf,nerf", "--json"]].concat(),
    );
    let cached: Vec<bool> = printed
        .iter()
        .filter_map(|event| event["cached"].as_bool())
        .collect();
    assert_eq!(cached, [true, false, false, true, false]);
    let findings = &printed.last().expect("events")["findings"];
    let lines = findings["lines"].as_array().expect("lines");
    let labels: Vec<&str> = lines
        .iter()
        .filter_map(|line| line["label"].as_str())
        .collect();
    assert_eq!(
        labels,
        [
            "deep, splat",
            "deep, tsdf",
            "deep, nerf",
            "flat, splat",
            "flat, nerf"
        ]
    );
    assert!(
        findings["notes"][0]
            .as_str()
            .is_some_and(|note| note.contains("flat has no depth")),
        "{findings}"
    );
    for line in lines {
        assert_eq!(
            Some(line["method"].as_str()),
            line["label"].as_str().map(|label| label.split(", ").nth(1))
        );
        assert!(
            line["points"]
                .as_array()
                .is_some_and(|points| !points.is_empty()),
            "{line}"
        );
        for known in ["psnr", "seconds", "primitives", "bytes"] {
            assert!(
                line["summary"][known].as_f64() > Some(0.0),
                "{known}: {line}"
            );
        }
    }
    assert_chart(&folder.join("c"), "curve");
    assert_chart(&folder.join("c"), "curve-size");
    let page = std::fs::read_to_string(folder.join("c/curve.html")).expect("a page");
    assert!(
        page.contains("deep, nerf") && page.contains("flat has no depth"),
        "{page}"
    );

    // Training of a distance field ends once every image is fused, before the time limit.
    let printed = events(
        folder,
        &[
            "curve",
            "deep",
            "--method",
            "tsdf",
            "--seconds",
            "60",
            "--seeds",
            "1",
            "--out",
            "e",
            "--json",
        ],
    );
    let tsdf = &printed.last().expect("events")["findings"]["lines"][0]["runs"][0];
    assert_eq!(tsdf["end"]["step"], tsdf["settings"]["n_train"], "{tsdf}");
    assert!(
        tsdf["end"]["seconds"]
            .as_f64()
            .is_some_and(|secs| secs < 60.0),
        "{tsdf}"
    );

    assert_fails_with(
        folder,
        &[
            "curve",
            "flat",
            "--method",
            "tsdf",
            "--seconds",
            "1",
            "--out",
            "d",
        ],
        4,
        &["depth"],
    );
    assert_fails_with(
        folder,
        &["budget", "flat", "--method", "splat,nerf"],
        2,
        &["splat and nerf"],
    );
    assert_fails_with(
        folder,
        &["stability", "flat", "--method", "splat,nerf"],
        2,
        &["a single method"],
    );
}

#[test]
fn budget_bench_reports_the_automatic_count() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    scene(folder);
    let printed = events(
        folder,
        &[
            "budget", ".", "--steps", "20", "--splats", "200,50", "--out", "b", "--json",
        ],
    );
    let findings = &printed.last().expect("events")["findings"];
    assert!(
        findings["automatic"]["psnr"]
            .as_f64()
            .is_some_and(f64::is_finite),
        "{findings}"
    );
    let caps: Vec<u64> = findings["caps"]
        .as_array()
        .expect("caps")
        .iter()
        .map(|capped| capped["cap"].as_u64().expect("a cap"))
        .collect();
    assert_eq!(caps, [50, 200]);
    for capped in findings["caps"].as_array().expect("caps") {
        assert!(
            capped["primitives"].as_f64() <= capped["cap"].as_f64(),
            "{capped}"
        );
    }
    assert_chart(&folder.join("b"), "budget");
    assert_chart(&folder.join("b"), "budget-gain");
    assert_fails_with(
        folder,
        &["budget", ".", "--max-splats", "9"],
        2,
        &["--max-splats", "--splats"],
    );
}

#[test]
fn ablation_bench_reports_gains() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    scene(folder);
    let args = [
        "ablation",
        ".",
        "--steps",
        "30",
        "--seeds",
        "1",
        "--only",
        "structure,black",
        "--out",
        "a",
    ];
    let printed = events(folder, &[&args[..], &["--json"]].concat());
    let changes = printed.last().expect("events")["findings"]["changes"]
        .as_array()
        .expect("changes")
        .clone();
    let names: Vec<&str> = changes
        .iter()
        .filter_map(|change| change["name"].as_str())
        .collect();
    assert_eq!(names, ["baseline", "no structure loss", "black background"]);
    let psnrs: Vec<f64> = changes
        .iter()
        .filter_map(|change| change["psnr"].as_f64())
        .collect();
    assert!(
        psnrs.len() == 3 && psnrs[1] != psnrs[0] && psnrs[2] != psnrs[0],
        "the changes reach the trainer: {psnrs:?}"
    );
    assert_eq!(changes[1]["gain_db"].as_f64(), Some(psnrs[0] - psnrs[1]));
    let page = std::fs::read_to_string(folder.join("a/ablation.html")).expect("a page");
    assert!(page.contains("black background"), "{page}");
    assert_fails_with(
        folder,
        &["ablation", ".", "--only", "nothing", "--out", "b"],
        2,
        &["--only", "no growth"],
    );
}

#[test]
fn stability_bench_is_repeatable_and_needs_times() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    scene(folder);
    let small = ["--steps", "20", "--max-splats", "300", "--json"];
    let poses = [
        "stability",
        ".",
        "--disturb",
        "pose-noise",
        "--levels",
        "0,50",
        "--out",
    ];
    let measured = |out: &str| {
        let printed = events(folder, &[&poses[..], &[out], &small].concat());
        printed.last().expect("events")["findings"]["disturbances"].clone()
    };
    let (first, second) = (measured("s"), measured("again"));
    let psnrs = |of: &Value| -> Vec<f64> {
        let points = of[0]["variants"][0]["points"].as_array().expect("points");
        points
            .iter()
            .map(|point| point["psnr"].as_f64().expect("a score"))
            .collect()
    };
    assert_eq!(psnrs(&first).len(), 2);
    assert_eq!(
        psnrs(&first),
        psnrs(&second),
        "the same seed gives the same result"
    );
    assert_ne!(
        psnrs(&first)[0],
        psnrs(&first)[1],
        "the noise affects training"
    );
    assert_chart(&folder.join("s"), "stability-pose-noise");

    let clock = [
        "stability",
        ".",
        "--disturb",
        "clock-offset",
        "--levels",
        "100",
        "--out",
        "t",
    ];
    assert_fails_with(folder, &clock, 2, &["clock-offset", "--rate-hz"]);
    let n_runs = |refine: &str, out: &str| {
        let clock = [
            &clock[..7],
            &[out, "--rate-hz", "10", "--refine", refine],
            &small,
        ]
        .concat();
        events(folder, &clock)
            .iter()
            .filter(|event| event["event"] == "run")
            .count()
    };
    assert_eq!(n_runs("none", "t"), 2, "undisturbed, and 100 ms");
    assert_eq!(
        n_runs("image-gains", "u"),
        4,
        "each with and without the estimated camera parameters"
    );
    let few = [
        "stability",
        ".",
        "--disturb",
        "keyframes,exposure",
        "--levels",
        "1",
    ];
    assert_fails_with(folder, &few, 2, &["--levels", "a single disturbance"]);
}
