//! `fieldrig view`: serves saved models on the web page.

use crate::exit::Exit;
use crate::open_gpu::open_gpu;
use crate::page_args::PageArgs;
use crate::signals;
use kinematics::Transform;
use messages::BadInput;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use serde_json::{Value, json};
use session::{ModelViewer, ServedModel, camera_list, gpu_notes, methods, run_folder, scene_hint};
use std::path::{Path, PathBuf};
use trainer::{Bounds, LoadedModel, ModelKind, Progress};
use viz::{Hub, KeyframePose, ModelStatus, SceneHint, Status};

/// Flags of `view`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder of a saved model or of a run with several methods, or a splat file (.ply, .spz,
    /// .splat)
    model: PathBuf,
    #[command(flatten)]
    page: PageArgs,
    /// Axis of the model that points up: x, y, z, -x, -y or -z; files from other programs are often
    /// -y up
    #[arg(long, value_name = "AXIS", default_value = "z", allow_hyphen_values = true, value_parser = up_axis)]
    up: Up,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

/// Direction that points up in the model's world.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Up(Vector3<f64>);

fn up_axis(text: &str) -> Result<Up, String> {
    let (sign, axis) = text
        .strip_prefix('-')
        .map_or((1.0, text), |axis| (-1.0, axis));
    let axis = match axis {
        "x" => Vector3::x(),
        "y" => Vector3::y(),
        "z" => Vector3::z(),
        _ => return Err("expected x, y, z, -x, -y or -z".to_owned()),
    };
    Ok(Up(sign * axis))
}

impl Up {
    /// Rotation from the page, which is z up, to the model.
    fn model_from_page(self) -> Transform {
        let rotation = UnitQuaternion::rotation_between(&Vector3::z(), &self.0);
        // If the two are opposite, rotate by 180 degrees about a horizontal axis.
        let rotation =
            rotation.unwrap_or_else(|| UnitQuaternion::new(std::f64::consts::PI * Vector3::x()));
        Transform::from_parts(Translation3::identity(), rotation)
    }
}

/// Serves the page until Ctrl-C.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    args.page.check()?;
    check_is_model(&args.model)?;
    let paths = run_folder::models_at(&args.model)?;
    let stop = signals::stop_on_signals_logging("stopping; Ctrl-C again exits at once")?;
    let gpu = open_gpu()?;
    let hub = Hub::new();
    // Before the models are loaded, so that an address in use is reported at once.
    let page = args.page.serve_or_free_port(&hub)?;

    let model_from_page = args.up.model_from_page();
    let cameras = cameras(&paths);
    let models = paths.iter().map(|path| methods::load(gpu.clone(), path));
    let mut models = models.collect::<anyhow::Result<Vec<LoadedModel>>>()?;
    // Without cameras, the page needs another initial view, from outside the model. The bounds of a
    // model take time, so they are only computed then.
    let bounds = if cameras.is_empty() {
        bounds(&mut models)?
    } else {
        None
    };
    let empty_notes = paths
        .iter()
        .zip(&models)
        .filter_map(|(path, model)| methods::note_if_empty(path, model));
    let notes = gpu_notes(&gpu).into_iter().chain(empty_notes).collect();
    let mut statuses = paths
        .iter()
        .zip(&models)
        .map(|(path, model)| model_status(path, model));
    let report = report(&paths[0]);
    let status = Status {
        state: "viewing".to_owned(),
        seconds: report["done"]["seconds"].as_f64().unwrap_or_default(),
        keyframes: cameras.len() as u64,
        model: statuses.next().unwrap_or_default(),
        others: statuses.collect(),
        notes,
        ..Status::default()
    };
    let cameras = in_page(cameras, &model_from_page);
    if let Some(hint) = first_view(&cameras, bounds, &model_from_page) {
        hub.set_scene_hint(hint);
    }
    hub.set_keyframes(cameras);
    hub.set_status(status);

    let methods: Vec<&str> = models.iter().map(|model| model.kind.name()).collect();
    page.print(args.json, json!({ "methods": methods }))?;
    let served = |(
        LoadedModel {
            kind,
            method,
            edits,
        },
        path,
    )| ServedModel {
        kind,
        method,
        edits: edits.into(),
        path,
    };
    let models = models.into_iter().zip(paths).map(served).collect();
    ModelViewer::new(models, hub)
        .with_model_from_page(model_from_page)
        .serve(&stop);
    Ok(Exit::Done)
}

/// Rejects paths that are often mistaken for a model. The error names the command to use instead.
fn check_is_model(model: &Path) -> Result<(), BadInput> {
    let shown = model.display();
    let is_url = |scheme: &str| model.to_str().is_some_and(|text| text.starts_with(scheme));
    if ["http://", "https://", "ws://", "wss://"]
        .into_iter()
        .any(is_url)
    {
        return Err(BadInput(format!(
            "{shown} is the address of a page: open it in a browser; view shows saved models and splat files"
        )));
    }
    if model.is_file() && run_folder::is_recording(model) {
        return Err(BadInput(format!(
            "{shown} is a recording, not a model: train a model with `fieldrig train`, or watch one being trained with \
             `fieldrig run RIG.toml --from {shown}`"
        )));
    }
    if drivers::dataset::is_dataset_folder(model) && run_folder::models_at(model).is_err() {
        return Err(BadInput(format!(
            "{shown} is a dataset, not a model: train a model with `fieldrig train {shown}` and pass the folder of that run"
        )));
    }
    Ok(())
}

/// The cameras of the first model whose folder lists them. An unreadable list only causes a
/// warning.
fn cameras(models: &[PathBuf]) -> Vec<KeyframePose> {
    let folders = models.iter().filter(|model| model.is_dir());
    folders
        .filter_map(|folder| read_cameras(folder))
        .find(|cameras| !cameras.is_empty())
        .unwrap_or_default()
}

fn read_cameras(folder: &Path) -> Option<Vec<KeyframePose>> {
    camera_list::read(folder).unwrap_or_else(|error| {
        log::warn!("cannot show cameras: {error:#}");
        None
    })
}

fn in_page(cameras: Vec<KeyframePose>, model_from_page: &Transform) -> Vec<KeyframePose> {
    let page_from_model = model_from_page.inverse();
    let in_page = |camera: KeyframePose| KeyframePose {
        world_from_camera: page_from_model * camera.world_from_camera,
        ..camera
    };
    cameras.into_iter().map(in_page).collect()
}

/// Bounds of the first model that has any.
fn bounds(models: &mut [LoadedModel]) -> anyhow::Result<Option<Bounds>> {
    for model in models {
        if let Some(bounds) = model.method.model_mut().bounds()? {
            return Ok(Some(bounds));
        }
    }
    Ok(None)
}

/// The initial view: from the first camera or, without cameras, from outside the model; `None` for
/// an empty model.
fn first_view(
    cameras: &[KeyframePose],
    bounds: Option<Bounds>,
    model_from_page: &Transform,
) -> Option<SceneHint> {
    let poses = cameras
        .iter()
        .map(|camera| camera.world_from_camera)
        .collect();
    scene_hint::from_cameras(poses).or_else(|| {
        let Bounds { center_m, radius_m } = bounds?;
        // The frame of the page may differ from that of the model.
        let center = model_from_page.inverse() * nalgebra::Point3::from(center_m);
        Some(scene_hint::from_bounds(&Bounds {
            center_m: center.coords.into(),
            radius_m,
        }))
    })
}

/// The report in a model's folder; `Null` if there is none.
fn report(model: &Path) -> Value {
    // Splat files of other programs have no report.
    let text = files::read_text(&model.join("report.json")).unwrap_or_default();
    serde_json::from_str(&text).unwrap_or_default()
}

/// Size and scores of a model at the end of its training.
fn model_status(path: &Path, model: &LoadedModel) -> ModelStatus {
    ModelStatus {
        edits: model.edits.len(),
        ..trained_status(path, model.kind, &model.method.model().progress())
    }
}

fn trained_status(model: &Path, kind: ModelKind, progress: &Progress) -> ModelStatus {
    let report = report(model);
    let done = &report["done"];
    let evaluations = report["evaluations"].as_array();
    ModelStatus {
        method: kind.name().to_owned(),
        step: done["steps"].as_u64().unwrap_or(progress.step),
        step_millis: None,
        primitives: progress.primitives,
        primitives_label: kind.entry().primitives_label.to_owned(),
        bytes: progress.bytes,
        has_chunks: kind.entry().has_chunks,
        edits: 0,
        psnr: done["psnr"].as_f64(),
        psnr_history: evaluations
            .into_iter()
            .flatten()
            .chain([done])
            .filter_map(scored_point)
            .collect(),
    }
}

/// Training time and PSNR of an evaluation; `None` if it has no PSNR.
fn scored_point(evaluation: &Value) -> Option<(f64, f64)> {
    Some((
        evaluation["seconds"].as_f64()?,
        evaluation["psnr"].as_f64()?,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    #[test]
    fn up_axis_is_up_on_the_page() {
        const TOLERANCE: f64 = 1e-12;
        for (text, up) in [
            ("z", [0.0, 0.0, 1.0]),
            ("-z", [0.0, 0.0, -1.0]),
            ("y", [0.0, 1.0, 0.0]),
            ("-y", [0.0, -1.0, 0.0]),
            ("-x", [-1.0, 0.0, 0.0]),
        ] {
            let Up(axis) = up_axis(text).expect("an axis");
            assert_eq!(axis, Vector3::from(up), "{text}");
            let in_page = Up(axis).model_from_page().inverse() * Point3::from(up);
            assert!(
                (in_page - Point3::new(0.0, 0.0, 1.0)).norm() < TOLERANCE,
                "{text}: {in_page}"
            );
        }
        for invalid in ["", "up", "--z", "Z", "xy"] {
            assert!(up_axis(invalid).is_err(), "{invalid}");
        }
    }

    #[test]
    fn model_status_uses_the_report_scores() {
        let folder = tempfile::tempdir().expect("a folder");
        let progress = Progress {
            primitives: 5,
            bytes: 80,
            ..Progress::default()
        };
        let status = trained_status(folder.path(), ModelKind::default(), &progress);
        assert_eq!(
            (status.psnr, status.step, status.primitives, status.bytes),
            (None, 0, 5, 80)
        );
        let text = json!({
            "done": { "psnr": 23.5, "steps": 700, "seconds": 8.0 },
            "evaluations": [{ "seconds": 0.5, "psnr": 20.0 }, { "seconds": 1.0, "psnr": null }, { "seconds": 2.0, "psnr": 22.0 }],
        });
        std::fs::write(folder.path().join("report.json"), text.to_string())
            .expect("the file is writable");
        let status = trained_status(folder.path(), ModelKind::default(), &progress);
        assert_eq!((status.psnr, status.step), (Some(23.5), 700));
        assert_eq!(status.psnr_history, [(0.5, 20.0), (2.0, 22.0), (8.0, 23.5)]);
    }
}
