//! Compares what samples files may contain with docs/reference/samples.md.

use super::{FILE_KEYS, SAMPLE_KEYS, SamplesFile};
use crate::lens::{LensFile, param_names};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// A folder with empty images. Reading a samples file does not open the images.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    for image in ["0.png", "1.png", "2.png"] {
        std::fs::write(folder.path().join(image), "").expect("a file");
    }
    folder
}

fn pose(x_m: f64) -> Value {
    json!([[1, 0, 0, x_m], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
}

fn file() -> Value {
    let intrinsics =
        json!({"focal_px": [600, 600], "principal_px": [320, 240], "distortion": [0.1]});
    let sample = |x_m: f64, image: &str| json!({"base_from_flange": pose(x_m), "image": image});
    json!({
        "intrinsics": intrinsics, "target": "charuco:5x7:34mm:26mm:5X5_100", "samples": [sample(0.0, "0.png"), sample(0.1, "1.png")],
    })
}

fn read_text(folder: &Path, text: &str) -> Result<SamplesFile, String> {
    let path = folder.join("samples.json");
    std::fs::write(&path, text).expect("a file");
    SamplesFile::read(&path).map_err(|error| error.to_string())
}

fn read(folder: &Path, file: &Value) -> Result<SamplesFile, String> {
    read_text(folder, &file.to_string())
}

/// The object to which the keys of a place in the documentation belong.
fn object_at<'a>(file: &'a mut Value, place: &str) -> &'a mut Value {
    match place {
        "file" => file,
        "sample" => &mut file["samples"][1],
        "intrinsics" => &mut file["intrinsics"],
        "sigma" => &mut file["intrinsics"]["sigma"],
        other => panic!("unknown place {other:?}"),
    }
}

/// Rows of the tables in the documentation: key and place, and how the key is used.
fn documented() -> BTreeMap<(&'static str, &'static str), &'static str> {
    let page = include_str!("../../../../../docs/reference/samples.md");
    let rows = page.lines().filter_map(|line| {
        line.strip_prefix("| `")?
            .trim_end_matches(" |")
            .split_once("` | ")
    });
    let cells = rows.map(|(key, rest)| (key, rest.split(" | ").collect::<Vec<_>>()));
    cells
        .map(|(key, rest)| match rest[..] {
            [place, _, used] => ((place, key), used),
            _ => panic!("{key}: {rest:?}"),
        })
        .collect()
}

#[test]
fn every_key_is_used_or_known_as_information_as_documented() {
    let known = |place: &'static str, keys: &[&'static str]| {
        keys.iter().map(|key| (place, *key)).collect::<Vec<_>>()
    };
    let sigmas = param_names(Some("brown_conrady"));
    let places = [
        known("file", &FILE_KEYS),
        known("sample", &SAMPLE_KEYS),
        known("intrinsics", &LensFile::KEYS),
        known("sigma", &sigmas),
    ];
    let documented = documented();
    let expected: BTreeSet<(&str, &str)> = places.concat().into_iter().collect();
    assert_eq!(
        documented.keys().copied().collect::<BTreeSet<_>>(),
        expected
    );
    let folder = folder();
    let shown = |file: &Value| read(folder.path(), file).map(|read| format!("{read:?}"));
    for ((place, key), used) in documented {
        let mut unchanged = file();
        if place == "sigma" {
            unchanged["intrinsics"]["sigma"] = json!({});
        }
        let value = match key {
            "intrinsics" => json!({"focal_px": [500, 500], "principal_px": [320, 240]}),
            "target" => json!("charuco:5x7:30mm:22mm:5X5_100"),
            "setup" => json!("eye-to-hand"),
            "samples" => json!([unchanged["samples"][0]]),
            "base_from_flange" => pose(0.5),
            "camera_from_board" => {
                unchanged["samples"][1]["image"] = Value::Null;
                unchanged["samples"][1][key] = pose(0.25);
                pose(0.5)
            }
            "image" => json!("2.png"),
            "focal_px" | "principal_px" => json!([300, 200]),
            "lens" | "model" => json!("kannala_brandt"),
            "size_px" => json!([640, 480]),
            "sigma" => json!({"fx": 0.5}),
            _ if place == "sigma" => json!(0.5),
            _ => json!([0.25]),
        };
        let mut changed = unchanged.clone();
        object_at(&mut changed, place)[key] = value;
        let before = shown(&unchanged).expect("a valid file");
        let after = shown(&changed).unwrap_or_else(|error| panic!("{key} of {place}: {error}"));
        match used {
            "yes" => {
                assert_ne!(after, before, "{key} of {place}");
                object_at(&mut changed, place)[key] = true.into();
                let error = shown(&changed).expect_err(key);
                assert!(
                    error.contains("samples.json") && error.contains(key),
                    "{key} of {place}: {error}"
                );
            }
            "no" => assert_eq!(after, before, "{key} of {place}"),
            other => panic!("{key}: unknown use {other:?}"),
        }
    }
}

#[test]
fn unknown_and_repeated_keys_are_refused_everywhere() {
    let folder = folder();
    for place in ["file", "sample", "intrinsics", "sigma"] {
        let mut more = file();
        more["intrinsics"]["sigma"] = json!({"fx": 0.5});
        let object = object_at(&mut more, place);
        let key = object
            .as_object()
            .and_then(|object| object.keys().next().cloned())
            .expect("a key");
        let text = object.to_string();
        object["kye"] = 1.into();
        let error = read(folder.path(), &more).expect_err("an unknown key");
        assert!(error.contains("unknown key \"kye\""), "{place}: {error}");
        object_at(&mut more, place)
            .as_object_mut()
            .expect("an object")
            .remove("kye");
        let twice = format!("{{\"{key}\":null,{}", &text[1..]);
        let whole = more.to_string();
        assert!(whole.contains(&text), "{text} is in {whole}");
        let error = read_text(folder.path(), &whole.replacen(&text, &twice, 1))
            .expect_err("a repeated key");
        assert!(
            error.contains(&format!(
                "the key {key:?} occurs twice; keep one of them at line 1"
            )),
            "{place}: {error}"
        );
    }
}

/// A place, a key, its value, and words that the error contains.
type Contradiction = (&'static str, &'static str, Value, &'static str);

#[test]
fn contradictions_and_values_that_cannot_be_true_are_refused() {
    let folder = folder();
    let identity = pose(0.0);
    let mut uneven = identity.clone();
    uneven[0] = json!([1, 0, 0]);
    uneven[1] = json!([0, 0, 1, 0, 0]);
    let mut far = identity.clone();
    far[2][3] = json!(-1e300);
    let cases: [Contradiction; 13] = [
        (
            "sample",
            "camera_from_board",
            identity,
            "samples[1].image: give either \"image\" or \"camera_from_board\"",
        ),
        (
            "sample",
            "image",
            "0.png".into(),
            "0.png is the image of samples[0], too, which has another robot pose",
        ),
        ("sample", "image", "gone.png".into(), "samples[1].image: "),
        (
            "sample",
            "base_from_flange",
            Value::Null,
            "samples[1].base_from_flange: missing",
        ),
        (
            "sample",
            "base_from_flange",
            uneven,
            "must be a matrix of 4 x 4 numbers",
        ),
        (
            "sample",
            "base_from_flange",
            far,
            "its position is 1e300 m away, at most 1e4 m are accepted; write meters",
        ),
        (
            "file",
            "setup",
            "eye_in_hand".into(),
            "setup: \"eye_in_hand\", expected \"eye-in-hand\" or \"eye-to-hand\"",
        ),
        (
            "file",
            "target",
            Value::Null,
            "target: missing; samples with images need it",
        ),
        (
            "file",
            "intrinsics",
            Value::Null,
            "intrinsics: missing; samples with images need them",
        ),
        ("file", "samples", json!([]), "samples: the list is empty"),
        (
            "intrinsics",
            "focal_px",
            json!([600]),
            "intrinsics.focal_px: 1 numbers, expected 2",
        ),
        (
            "intrinsics",
            "size_px",
            json!([640.5, 480]),
            "intrinsics.size_px: must be whole numbers above 0",
        ),
        (
            "intrinsics",
            "sigma",
            json!({"fx": -1}),
            "intrinsics.sigma.fx: expected a number of at least 0",
        ),
    ];
    for (place, key, value, words) in cases {
        let mut changed = file();
        object_at(&mut changed, place)[key] = value;
        let error = read(folder.path(), &changed).expect_err(words);
        assert!(
            error.contains(words) && error.contains("samples.json"),
            "{error}"
        );
    }
    let mut two_models = file();
    two_models["intrinsics"]["model"] = "brown_conrady".into();
    two_models["intrinsics"]["lens"] = "kannala_brandt".into();
    let error = read(folder.path(), &two_models).expect_err("two models");
    assert!(
        error.contains("intrinsics.lens: \"kannala_brandt\", but model is \"brown_conrady\""),
        "{error}"
    );
    two_models["intrinsics"]["lens"] = "brown_conrady".into();
    read(folder.path(), &two_models).expect("one model, twice");
    let mut identical = file();
    identical["samples"][1] = identical["samples"][0].clone();
    read(folder.path(), &identical).expect("identical samples count once");
}

#[test]
fn contradictory_uncertainties_of_the_lens_are_refused() {
    const SIZE_PX: [u32; 2] = [640, 480];
    let folder = folder();
    let covariance_of = |changes: &Value| {
        let mut changed = file();
        for (key, value) in changes.as_object().expect("an object") {
            changed["intrinsics"][key] = value.clone();
        }
        let read = read(folder.path(), &changed)?;
        let intrinsics = read
            .intrinsics(SIZE_PX)
            .map_err(|error| error.to_string())?
            .expect("intrinsics");
        read.intrinsics_covariance(&intrinsics)
            .map_err(|error| error.to_string())
    };
    assert_eq!(covariance_of(&json!({})), Ok(None));
    let independent = covariance_of(&json!({"sigma": {"fy": 0.5}}))
        .expect("valid")
        .expect("given");
    assert_eq!(
        (independent[(1, 1)], independent.sum(), independent.nrows()),
        (0.25, 0.25, 9)
    );
    let diagonal: Vec<f64> = (0..81)
        .map(|ix| if ix % 10 == 0 { 0.04 } else { 0.0 })
        .collect();
    let agreeing =
        covariance_of(&json!({"covariance": diagonal, "sigma": {"fx": 0.2001, "k3": 0.2}}));
    assert_eq!(agreeing.expect("valid").expect("given")[(8, 8)], 0.04);
    for (changes, words) in [
        (
            json!({"covariance": diagonal, "sigma": {"cx": 0.3}}),
            "sigma.cx is 0.3, but intrinsics.covariance means 0.2",
        ),
        (
            json!({"covariance": [1, 2]}),
            "intrinsics.covariance: 2 numbers, but the lens has 9 parameters",
        ),
        (
            json!({"sigma": {"k4": 0.1}}),
            "intrinsics.sigma.k4: the lens ",
        ),
        (
            json!({"lens": "kannala_brandt", "sigma": {"p1": 0.1}}),
            "unknown key \"p1\"",
        ),
    ] {
        let error = covariance_of(&changes).expect_err(words);
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn parts_without_effect_are_named() {
    let folder = folder();
    let unused = |file: &Value, estimates_joints| {
        read(folder.path(), file)
            .expect("valid")
            .unused(estimates_joints)
    };
    assert_eq!(unused(&file(), false), [""; 0]);
    let mut poses = file();
    for sample in poses["samples"].as_array_mut().expect("a list") {
        *sample = json!({"base_from_flange": pose(0.0), "camera_from_board": pose(0.5), "joints": [0.1, 0.2]});
    }
    let intrinsics = "intrinsics are not used, because no sample has an image";
    assert_eq!(
        unused(&poses, false),
        [intrinsics, "joints are only used with with_joints"]
    );
    assert_eq!(unused(&poses, true), [intrinsics]);
}
