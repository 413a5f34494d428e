//! Shows saved models to viewers: their cameras, scores and initial view.

use crate::run_folder::{is_recording, models_at, report};
use crate::scene_hint::SceneView;
use crate::viewer::ServedModel;
use crate::{camera_list, incident_view, methods, model_source, served_files, viewers};
use gpu::Gpu;
use kinematics::Transform;
use messages::{BadInput, Setting};
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::{Bounds, LoadedModel, ModelKind, Progress};
use viz::{Hub, Identity, KeyframePose, ModelStatus, OperatorStatus, StateProgress, Status};

/// Reads saved models, and publishes them to viewers.
///
/// * `paths`: folders or files of the models.
/// * `model_from_page`: pose of the page's world, which is z up, in the world of the models.
///
/// # Errors
///
/// If a model cannot be read.
pub fn load_saved(
    hub: &Hub,
    gpu: &Arc<Gpu>,
    paths: Vec<PathBuf>,
    model_from_page: &Transform,
) -> anyhow::Result<Vec<ServedModel>> {
    let mut models = Vec::new();
    for (ix, path) in paths.iter().enumerate() {
        publish_loading(hub, &paths, ix);
        models.push(methods::load(Arc::clone(gpu), path)?);
    }
    publish_saved(hub, gpu, &mut models, &paths, model_from_page)?;
    let served = |(loaded, path)| {
        let LoadedModel {
            kind,
            method,
            edits,
        } = loaded;
        ServedModel {
            kind,
            method,
            edits: edits.into(),
            path,
        }
    };
    Ok(models.into_iter().zip(paths).map(served).collect())
}

/// Publishes the cameras, the status and the initial view of saved models.
///
/// * `paths`: folders or files of the models, in the same order.
/// * `model_from_page`: pose of the page's world, which is z up, in the world of the models.
fn publish_saved(
    hub: &Hub,
    gpu: &Gpu,
    models: &mut [LoadedModel],
    paths: &[PathBuf],
    model_from_page: &Transform,
) -> anyhow::Result<()> {
    let cameras = cameras(paths);
    let bounds = bounds(models)?;
    let mut notes = viewers::gpu_notes(gpu);
    let mut statuses = Vec::new();
    for (path, model) in paths.iter().zip(&*models) {
        notes.extend(methods::note_if_empty(path, model));
        statuses.push(model_status(path, model, model_from_page));
    }
    let report = paths.first().map_or(Value::Null, |path| report(path));
    let kinds: Vec<ModelKind> = models.iter().map(|model| model.kind).collect();
    let mut statuses = statuses.into_iter();
    let status = Status {
        state: "viewing".to_owned(),
        seconds: report["done"]["seconds"].as_f64().unwrap_or_default(),
        keyframes: cameras.len() as u64,
        model: statuses.next().unwrap_or_default(),
        others: statuses.collect(),
        source: Some(model_source::of_saved(paths, &kinds, model_from_page)),
        notes,
        operator: OperatorStatus {
            identity: Some(identity(paths)),
            ..OperatorStatus::default()
        },
        ..Status::default()
    };
    let cameras = in_page(cameras, model_from_page);
    if let Some(view) = first_view(&cameras, bounds, model_from_page) {
        view.publish(hub);
    }
    hub.keyframes().set(cameras);
    hub.set_status(status);
    let mut files = served_files::of_models(kinds.iter().copied().zip(paths));
    files.extend(incident_view::publish(hub, paths, model_from_page));
    viz::publish_files(hub, files);
    Ok(())
}

/// Name of the folder or file of the model. Several models of a run have a folder in common.
fn identity(paths: &[PathBuf]) -> Identity {
    let first = paths.first().map(PathBuf::as_path);
    let named = match (first, paths.len()) {
        (Some(path), 2..) => path.parent(),
        (path, _) => path,
    };
    let name = named.and_then(Path::file_name);
    Identity {
        run: name.map(|name| name.to_string_lossy().into_owned()),
        ..Identity::default()
    }
}

/// Publishes that a saved model is being read, before [`publish_saved`].
///
/// * `ix`: index of the model in `paths`.
fn publish_loading(hub: &Hub, paths: &[PathBuf], ix: usize) {
    let name = paths[ix].display();
    let text = match paths.len() {
        1 => name.to_string(),
        n_all => format!("{} of {n_all}: {name}", ix + 1),
    };
    let progress = StateProgress::of_parts(text, ix, paths.len());
    hub.set_state_and_progress("loading the model", Some(progress.at_startup()));
}

/// Pose of the page's world, which is z up, in the world of a model.
///
/// * `up`: direction that points up in the world of the model.
#[must_use]
pub fn model_from_page(up: &Vector3<f64>) -> Transform {
    let rotation = UnitQuaternion::rotation_between(&Vector3::z(), up);
    // If the two directions are opposite, rotate by 180 degrees about a horizontal axis.
    let rotation =
        rotation.unwrap_or_else(|| UnitQuaternion::new(std::f64::consts::PI * Vector3::x()));
    Transform::from_parts(Translation3::identity(), rotation)
}

/// Rejects paths that are often mistaken for a model. The error names the command to use instead.
///
/// # Errors
///
/// If the path is the address of a page, a recording or a dataset.
pub fn check_is_model(model: &Path) -> Result<(), BadInput> {
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
    if model.is_file() && is_recording(model) {
        return Err(BadInput(format!(
            "{shown} is a recording, not a model: train a model with `fieldrig train`, or watch one being trained with \
             `fieldrig run RIG.toml {} {shown}`",
            Setting::From
        )));
    }
    if drivers::dataset::is_dataset_folder(model) && models_at(model).is_err() {
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

/// The extent of the model, and the view of its first camera; `None` for an empty model.
fn first_view(
    cameras: &[KeyframePose],
    bounds: Option<Bounds>,
    model_from_page: &Transform,
) -> Option<SceneView> {
    let poses: Vec<_> = cameras
        .iter()
        .map(|camera| camera.world_from_camera)
        .collect();
    let in_page = bounds.map(|bounds| {
        // The frame of the page may differ from the frame of the model.
        let center = model_from_page.inverse() * Point3::from(bounds.center_m);
        Bounds {
            center_m: center.coords.into(),
            ..bounds
        }
    });
    SceneView::of_model(&poses, in_page.as_ref())
}

/// Size and scores of a model at the end of its training.
fn model_status(path: &Path, model: &LoadedModel, model_from_page: &Transform) -> ModelStatus {
    trained_status(path, model.kind, &model.method.model().progress())
        .with_edits(&model.edits, &model_from_page.inverse())
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
        // A loaded model needs less memory than a model in training. The page shows the number in
        // the report, as it did during the run.
        bytes: done["bytes"].as_u64().unwrap_or(progress.bytes),
        has_chunks: kind.entry().has_chunks,
        psnr: done["psnr"].as_f64(),
        psnr_history: evaluations
            .into_iter()
            .flatten()
            .chain([done])
            .filter_map(scored_point)
            .collect(),
        ..ModelStatus::default()
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
    use serde_json::json;

    #[test]
    fn a_saved_model_is_named_after_its_folder_or_file() {
        let name = |paths: &[&str]| {
            let paths: Vec<PathBuf> = paths.iter().map(PathBuf::from).collect();
            identity(&paths).run
        };
        assert_eq!(name(&["files/guitar.ply"]).as_deref(), Some("guitar.ply"));
        assert_eq!(name(&["runs/kitchen"]).as_deref(), Some("kitchen"));
        let several = ["runs/kitchen/splat", "runs/kitchen/tsdf"];
        assert_eq!(name(&several).as_deref(), Some("kitchen"));
        assert_eq!(name(&[]), None);
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
            "done": { "psnr": 23.5, "steps": 700, "seconds": 8.0, "bytes": 120 },
            "evaluations": [{ "seconds": 0.5, "psnr": 20.0 }, { "seconds": 1.0, "psnr": null }, { "seconds": 2.0, "psnr": 22.0 }],
        });
        std::fs::write(folder.path().join("report.json"), text.to_string())
            .expect("the file is writable");
        let status = trained_status(folder.path(), ModelKind::default(), &progress);
        assert_eq!(
            (status.psnr, status.step, status.bytes),
            (Some(23.5), 700, 120)
        );
        assert_eq!(status.psnr_history, [(0.5, 20.0), (2.0, 22.0), (8.0, 23.5)]);
    }

    #[test]
    fn up_axis_is_up_on_the_page() {
        const TOLERANCE: f64 = 1e-12;
        for up in [
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
            [0.0, 1.0, 0.0],
            [0.0, -1.0, 0.0],
            [-1.0, 0.0, 0.0],
        ] {
            let in_page = model_from_page(&up.into()).inverse() * Point3::from(up);
            assert!(
                (in_page - Point3::new(0.0, 0.0, 1.0)).norm() < TOLERANCE,
                "{up:?}: {in_page}"
            );
        }
    }
}
