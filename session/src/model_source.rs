//! Describes the saved model or file that `view` shows.

use crate::run_folder::report;
use crate::verdict;
use kinematics::Transform;
use nalgebra::Vector3;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;
use trainer::ModelKind;
use viz::{ModelSource, SourceKind};

/// Describes models that are viewed together.
///
/// * `paths`: folders or files of the models, at least one.
/// * `kinds`: the kind of each one.
/// * `model_from_page`: pose of the page's world, which is z up, in the world of the models.
pub(crate) fn of_saved(
    paths: &[PathBuf],
    kinds: &[ModelKind],
    model_from_page: &Transform,
) -> ModelSource {
    let first = paths.first().map_or(Path::new(""), PathBuf::as_path);
    // Several models are in subfolders of one run.
    let whole = match paths {
        [_, _, ..] => first.parent().unwrap_or(first),
        _ => first,
    };
    let is_file = whole.is_file();
    let files: Vec<PathBuf> = paths
        .iter()
        .zip(kinds)
        .flat_map(|(path, kind)| files_of(path, *kind))
        .collect();
    let report = report(first);
    let text = |key: &str| report[key].as_str().map(str::to_owned);
    ModelSource {
        kind: if is_file {
            SourceKind::File
        } else {
            SourceKind::Saved
        },
        name: name_of(whole),
        path: whole.display().to_string(),
        format: is_file.then(|| format_of(whole)),
        bytes: files.iter().filter_map(|file| size_of(file)).sum(),
        modified_unix_secs: files.iter().filter_map(|file| modified(file)).max(),
        data: text("data"),
        adapter: text("adapter"),
        verdict: verdict::of_report(&report),
        up_axis: up_axis(model_from_page),
    }
}

/// The files of a model.
fn files_of(path: &Path, kind: ModelKind) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let files = kind.entry().files.iter();
    files.map(|file| path.join(file)).collect()
}

fn size_of(file: &Path) -> Option<u64> {
    Some(file.metadata().ok()?.len())
}

/// When a file was changed, seconds since 1970.
fn modified(file: &Path) -> Option<u64> {
    let time = file.metadata().ok()?.modified().ok()?;
    Some(time.duration_since(UNIX_EPOCH).ok()?.as_secs())
}

/// Name of a path without its parents. The path `.` gets the name of the current folder.
fn name_of(path: &Path) -> String {
    let full = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let name = full.file_name().unwrap_or(path.as_os_str());
    name.to_string_lossy().into_owned()
}

/// Format of a file: its extension in upper case.
fn format_of(file: &Path) -> String {
    let extension = file.extension().unwrap_or_default();
    extension.to_string_lossy().to_uppercase()
}

/// The axis of the model that is nearest to the page's z axis.
fn up_axis(model_from_page: &Transform) -> &'static str {
    let up_in_model = model_from_page.rotation * Vector3::z();
    match (up_in_model.iamax(), up_in_model[up_in_model.iamax()] > 0.0) {
        (0, true) => "x",
        (0, false) => "-x",
        (1, true) => "y",
        (1, false) => "-y",
        (_, true) => "z",
        (_, false) => "-z",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};
    use serde_json::json;
    use viz::{Grade, Verdict};

    fn splat() -> ModelKind {
        ModelKind::from_name("splat").expect("registered")
    }

    #[test]
    fn foreign_file_has_name_format_and_size() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("guitar.compressed.ply");
        std::fs::write(&path, [0; 120]).expect("written");
        let source = of_saved(
            std::slice::from_ref(&path),
            &[splat()],
            &Transform::identity(),
        );
        assert_eq!(
            (source.kind, &*source.name, source.format.as_deref()),
            (SourceKind::File, "guitar.compressed.ply", Some("PLY"))
        );
        assert_eq!((source.bytes, source.up_axis), (120, "z"));
        assert_eq!((source.verdict, source.data), (None, None));
        assert!(source.modified_unix_secs > Some(1_600_000_000));
    }

    #[test]
    fn saved_model_has_the_facts_of_its_report() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = folder.path().join("kitchen");
        let models = ["splat", "tsdf"].map(|method| run.join(method));
        for model in &models {
            std::fs::create_dir_all(model).expect("disk space");
            std::fs::write(model.join("splats.ply"), [0; 50]).expect("written");
        }
        let report = json!({
            "done": { "method": "splat", "psnr": 31.0 }, "per_image": [{}],
            "data": "scan.mcap", "adapter": "llvmpipe",
        });
        std::fs::write(models[0].join("report.json"), report.to_string()).expect("written");
        let source = of_saved(&models, &[splat(), splat()], &Transform::identity());
        assert_eq!(
            (source.kind, &*source.name, source.format, source.bytes),
            (SourceKind::Saved, "kitchen", None, 100)
        );
        assert_eq!(
            (source.data.as_deref(), source.adapter.as_deref()),
            (Some("scan.mcap"), Some("llvmpipe"))
        );
        let expected = Verdict {
            grade: Grade::Good,
            text: "Good: 31.0 dB on 1 test image".to_owned(),
        };
        assert_eq!(source.verdict, Some(expected));
    }

    #[test]
    fn up_axis_is_that_of_the_flag() {
        for (axis, name) in [
            (Vector3::x(), "x"),
            (-Vector3::x(), "-x"),
            (Vector3::y(), "y"),
            (-Vector3::y(), "-y"),
            (Vector3::z(), "z"),
        ] {
            let rotation =
                UnitQuaternion::rotation_between(&Vector3::z(), &axis).expect("not opposite");
            let pose = Transform::from_parts(Translation3::identity(), rotation);
            assert_eq!(up_axis(&pose), name);
        }
        let half_turn = Transform::rotation(std::f64::consts::PI * Vector3::x());
        assert_eq!(up_axis(&half_turn), "-z");
    }
}
