//! Saves the models of a live run, and ends it.

use super::RunPlan;
use super::no_model::no_model_reason;
use crate::error::is_rejection;
use crate::latency::Latency;
use crate::live_loop::{EndedLoop, LiveLoop};
use crate::models_verdict::{likely_cause_of, verdict_of};
use crate::next_commands::DataSource;
use crate::resume_command::ResumeCommand;
use crate::run_folder::{self, CreatedFolders};
use crate::session::{self, EndViewers, EndingSession, FinishedModel, Session};
use crate::verdict::ImageLoss;
use crate::viewer::ServedModel;
use crate::{corrected_rig, recovery, served_files};
use capture::config::Rig;
use capture::{Counts, DriftReport, InputResult, SampleUse, StationReport};
use keyframe::{Keyframe, Split};
use messages::InsufficientData;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use viz::{CheckpointState, Grade, Hub, RequestedCheckpoint, RunResult, Status, Verdict};

/// Name of the rig file with the corrections of a run.
pub(crate) const CORRECTED_RIG: &str = "corrected-rig.toml";
/// Time for which the server stays up, so that connected clients receive the last status. They are
/// on this computer or a local network, where a message arrives within milliseconds.
const FINAL_STATUS_TIME: Duration = Duration::from_millis(400);

/// A run whose models are saved and scored. [`Self::end`] returns the errors of its input.
pub struct SavedRun {
    /// The models; none if there was nothing to train on.
    pub models: Vec<FinishedModel>,
    hub: Hub,
    data_losses: Vec<String>,
    /// The color images that were received, and those that were dropped before.
    loss: ImageLoss,
    /// Whether the keyframe lists were written.
    listed: anyhow::Result<()>,
    /// The rig files of the models whose cameras were corrected.
    corrected_rigs: anyhow::Result<Vec<(Rig, PathBuf)>>,
    /// Error that ended the input early.
    input_error: Option<drivers::Error>,
    /// Why there was nothing to train on.
    no_model_reason: Option<String>,
    /// Error that ended the training early.
    pub(super) failure: Option<anyhow::Error>,
    pub(super) created: CreatedFolders,
    pub(super) has_keyframes: bool,
}

/// A run that has ended without an error.
pub struct EndedRun {
    /// The models, for viewers that stay connected.
    pub models: Vec<ServedModel>,
    /// Descriptions of data that are missing.
    pub data_losses: Vec<String>,
}

impl SavedRun {
    /// Publishes the result to viewers, writes corrected rig files, and returns the errors of the
    /// run. Removes the folders of a run that is rejected.
    pub fn end(mut self) -> anyhow::Result<EndedRun> {
        // The page shows the result before errors are returned, because viewers have waited for it.
        publish_end(&self.hub, &self);
        let created = std::mem::take(&mut self.created);
        let has_keyframes = self.has_keyframes;
        let failure = self.failure.take();
        let ended = match (failure, self.finish_files()) {
            (None, ended) => ended,
            (Some(failure), ended) => {
                match ended {
                    Ok(ended) => log_losses(&ended.data_losses),
                    Err(error) => log::error!("{error:#}"),
                }
                Err(failure)
            }
        };
        // The folder of a run that failed before its first keyframe contains nothing of use.
        let is_useless = |error: &anyhow::Error| !has_keyframes || is_rejection(error);
        created.keep_unless(ended.as_ref().is_err_and(is_useless));
        ended
    }

    /// How good the models are, in one sentence.
    pub fn verdict(&self) -> Verdict {
        verdict_of(&self.models, self.loss)
    }

    /// The likely cause of a poor result, and its remedy.
    pub fn likely_cause(&self) -> Option<String> {
        likely_cause_of(&self.models)
    }

    /// Errors that ended the run, descriptions of lost data, and the likely cause of a poor result.
    fn problems(&self) -> Vec<String> {
        let failure = self.failure.as_ref().map(|error| format!("{error:#}"));
        let input_error = self.input_error.as_ref().map(ToString::to_string);
        let mut problems: Vec<String> = failure
            .into_iter()
            .chain(input_error)
            .chain(self.no_model_reason.clone())
            .collect();
        problems.extend(self.data_losses.iter().cloned());
        let cause = self.likely_cause();
        problems.extend(cause.map(|cause| format!("Likely cause of the result: {cause}")));
        problems
    }

    /// Writes corrected rig files, and returns the first error of the lists, the files and the
    /// input.
    fn finish_files(self) -> anyhow::Result<EndedRun> {
        self.listed?;
        for (rig, file) in self.corrected_rigs? {
            corrected_rig::write(&rig, &file)?;
            log::info!(
                "rig file with the estimated corrections written to {}",
                file.display()
            );
        }
        if let Some(error) = self.input_error {
            return Err(anyhow::Error::new(error).context("a device failed"));
        }
        if let Some(reason) = self.no_model_reason {
            return Err(InsufficientData(reason).into());
        }
        Ok(EndedRun {
            models: self.models.into_iter().map(served).collect(),
            data_losses: self.data_losses,
        })
    }
}

/// A finished model as the page shows it after the run.
fn served(model: FinishedModel) -> ServedModel {
    let FinishedModel {
        kind,
        method,
        edits,
        folder,
        ..
    } = model;
    ServedModel {
        kind,
        method,
        edits,
        path: folder,
    }
}

/// Logs each loss of data as a warning.
fn log_losses(data_losses: &[String]) {
    for loss in data_losses {
        log::warn!("data loss: {loss}");
    }
}

/// Saves and scores the models. Errors of the input are returned only at the end of the run.
pub(super) fn save(
    mut live: LiveLoop,
    plan: &RunPlan,
    rig: &Rig,
    folders: Vec<PathBuf>,
    damage: &OnceLock<String>,
) -> anyhow::Result<SavedRun> {
    // Everything that describes the run is read first, because `finish` consumes it.
    let hub = live.hub();
    let n_keyframes = live.keyframes().len();
    let n_train = live
        .keyframes()
        .iter()
        .filter(|keyframe| keyframe.split == Split::Train)
        .count();
    let max_position_error_m = max_position_error_m(live.keyframes());
    let recoverable = live.describe_recoverable();
    let latencies = live.ledger().latencies();
    // Closes the recording and ends the input thread, whose counts are then final.
    let EndedLoop {
        mut sessions,
        input_result,
        mut viewers,
    } = live.finish();
    sessions
        .iter_mut()
        .for_each(|session| session.persistence().check_folders());
    let input_result = match input_result {
        Ok(input_result) => input_result,
        Err(error) => {
            // Save the models even if the input has failed.
            if n_train > 0 {
                save_after_input_failure(sessions, folders, &error, &mut viewers)?;
            }
            return Err(error);
        }
    };
    // Errors are returned only at the end: the models may still be saved even if the disk is too
    // full for the lists.
    let list = |(session, folder): (&Session, &PathBuf)| {
        run_folder::write_keyframe_list(&folder.join("keyframes.txt"), session.keyframes())
    };
    let listed = sessions.iter().zip(&folders).try_for_each(list);
    log::info!("{}", input_result.join.counts());
    if let Some(drift) = input_result.join.drift() {
        log::info!("{drift}");
    }
    // Commands that score the model later need a complete recording at this path.
    let is_moved = plan.record.as_ref().is_some_and(|file| !file.exists());
    let is_recorded = input_result.recording_error.is_none() && !is_moved;
    let data_losses = data_losses(plan, &input_result, damage);
    // The corrections are read before the models are saved, because saving consumes the sessions.
    let corrected_rigs = corrected_rigs(rig, &mut sessions, &folders);
    let mut details = DetailsOfRun {
        rig: plan.rig_name(),
        seed: rig.train.seed,
        resume_command: plan
            .checkpoints
            .are_written()
            .then(|| plan.resume_command()),
        input_result: &input_result,
        data_losses: &data_losses,
        latencies,
        max_position_error_m,
    };
    let mut endings = Vec::new();
    for (session, out) in sessions.into_iter().zip(folders) {
        endings.push(EndingSession {
            details: details.of(&session, &out),
            session: if is_recorded {
                session
            } else {
                session.with_data(DataSource::default())
            },
            out,
        });
    }
    let mut models = Vec::new();
    if n_train > 0 {
        let finished = session::finish(endings, Some(&mut viewers));
        models = finished.map_err(|error| recovery::with_recoverable(error, &recoverable))?;
    }
    let counts = input_result.join.counts();
    let no_model_reason = (n_train == 0).then(|| no_model_reason(n_keyframes, counts, rig));
    Ok(SavedRun {
        models,
        hub,
        data_losses,
        loss: ImageLoss {
            n_received: counts.images,
            n_lost: counts.color_skipped,
        },
        listed,
        corrected_rigs,
        input_error: input_result.input_error,
        no_model_reason,
        failure: None,
        created: CreatedFolders::default(),
        has_keyframes: n_keyframes > 0,
    })
}

/// Saves the models of a run whose input thread has failed.
fn save_after_input_failure(
    sessions: Vec<Session>,
    folders: Vec<PathBuf>,
    error: &anyhow::Error,
    viewers: &mut EndViewers,
) -> anyhow::Result<()> {
    let ending = |(session, out): (Session, PathBuf)| EndingSession {
        details: serde_json::json!({ "data_losses": [error.to_string()] }),
        session,
        out,
    };
    let endings = sessions.into_iter().zip(folders).map(ending).collect();
    session::finish(endings, Some(viewers)).map(drop)
}

/// Descriptions of the data that are missing.
fn data_losses(
    plan: &RunPlan,
    input_result: &InputResult,
    damage: &OnceLock<String>,
) -> Vec<String> {
    let is_recorded = plan.record.is_some() && plan.recording().is_none();
    let use_of_samples = if is_recorded {
        SampleUse::Recorded
    } else {
        SampleUse::ProcessedOnly
    };
    let mut data_losses = input_result.join.counts().data_losses(use_of_samples);
    data_losses.extend(
        input_result
            .recording_error
            .as_ref()
            .map(|error| format!("the recording is incomplete: {error:#}")),
    );
    data_losses.extend(damage.get().cloned());
    data_losses
}

/// The entries of the report besides scores.
#[derive(Debug, Serialize)]
struct RunDetails {
    /// Name of the rig file without its extension.
    rig: String,
    method: &'static str,
    seed: u64,
    keyframes: usize,
    evicted: u64,
    rejected: BTreeMap<&'static str, u64>,
    device_skipped: u64,
    color_skipped: u64,
    /// Number of range scans, which are stored in addition to the keyframes, and number of their
    /// points.
    range_scans: usize,
    range_points: usize,
    data_losses: Vec<String>,
    /// The command line that continues the run, if it has checkpoints.
    #[serde(skip_serializing_if = "Option::is_none")]
    resume_command: Option<String>,
    /// Estimated base pose at each station after the first.
    stations: Vec<StationReport>,
    /// What range scans showed about the drift of the base.
    #[serde(skip_serializing_if = "Option::is_none")]
    drift: Option<DriftReport>,
    /// Durations from mid-exposure to the model and to viewers, by name; only for the first model.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    latencies: Vec<(String, Latency)>,
    /// Largest camera position error of a keyframe, meters; only in simulation.
    #[serde(skip_serializing_if = "Option::is_none")]
    max_position_error_m: Option<f64>,
}

/// The entries of all reports of a run.
struct DetailsOfRun<'a> {
    rig: String,
    seed: u64,
    /// `None` if the run has no checkpoints.
    resume_command: Option<ResumeCommand>,
    input_result: &'a InputResult,
    data_losses: &'a [String],
    latencies: Vec<(String, Latency)>,
    max_position_error_m: Option<f64>,
}

impl DetailsOfRun<'_> {
    /// The entries for one model, which is saved in `folder`. Only the first one gets the latencies.
    fn of(&mut self, session: &Session, folder: &Path) -> RunDetails {
        let InputResult { join, stations, .. } = self.input_result;
        let Counts {
            evicted,
            rejected,
            device_skipped,
            color_skipped,
            ..
        } = join.counts();
        RunDetails {
            rig: self.rig.clone(),
            method: session.kind().name(),
            seed: self.seed,
            keyframes: session.keyframes().len(),
            evicted: *evicted,
            rejected: rejected.iter().map(|(why, n)| (why.name(), *n)).collect(),
            device_skipped: *device_skipped,
            color_skipped: *color_skipped,
            range_scans: join.range_scans().count(),
            range_points: join
                .range_scans()
                .map(|scan| scan.points_in_world_m.len())
                .sum(),
            data_losses: self.data_losses.to_vec(),
            resume_command: self
                .resume_command
                .as_ref()
                .map(|command| command.line(folder)),
            stations: stations
                .as_ref()
                .map_or(Vec::new(), |stations| stations.reports().to_vec()),
            drift: join.drift().cloned(),
            latencies: std::mem::take(&mut self.latencies),
            max_position_error_m: self.max_position_error_m,
        }
    }
}

/// The corrected rig files, with their paths, of the models whose cameras were corrected.
fn corrected_rigs(
    rig: &Rig,
    sessions: &mut [Session],
    folders: &[PathBuf],
) -> anyhow::Result<Vec<(Rig, PathBuf)>> {
    let mut rigs = Vec::new();
    for (session, folder) in sessions.iter_mut().zip(folders) {
        let learned = session.camera_corrections()?;
        let corrected = corrected_rig::corrected(rig, session.alignment(), &learned)?;
        // An unchanged rig file is not written, because it would look like a correction.
        if !corrected.has_same_calibration(rig) {
            rigs.push((corrected, folder.join(CORRECTED_RIG)));
        }
    }
    Ok(rigs)
}

/// Largest position error of the keyframes; `None` if no true poses are known (only simulators
/// report them).
fn max_position_error_m(keyframes: &[Arc<Keyframe>]) -> Option<f64> {
    keyframes
        .iter()
        .filter_map(position_error_m)
        .reduce(f64::max)
}

fn position_error_m(keyframe: &Arc<Keyframe>) -> Option<f64> {
    let truth = keyframe
        .truth
        .as_ref()?
        .world_from_camera
        .translation
        .vector;
    Some((keyframe.world_from_camera.translation.vector - truth).norm())
}

/// Publishes the result of a run to its page.
fn publish_end(hub: &Hub, saved: &SavedRun) {
    let models = &saved.models;
    let name = |model: &FinishedModel| match models.len() {
        1 => model.scores.to_string(),
        _ => format!("{} {}", model.kind.name(), model.scores),
    };
    // Several models have a subfolder each.
    let folder = models.first().map(|model| match models.len() {
        1 => model.folder.as_path(),
        _ => model.folder.parent().unwrap_or(&model.folder),
    });
    let final_scores = models
        .iter()
        .filter_map(|model| Some((model.kind.name(), model.seconds, model.scores.psnr?)));
    publish_final_scores(hub, final_scores);
    viz::publish_files(
        hub,
        served_files::of_models(models.iter().map(|model| (model.kind, &model.folder))),
    );
    let result = RunResult {
        folder: folder.map(|folder| folder.display().to_string()),
        scores: models.iter().map(name).collect::<Vec<_>>().join("; "),
        seconds: models.iter().map(|model| model.seconds).fold(0.0, f64::max),
        verdict: Some(saved.verdict()),
        problems: saved.problems(),
    };
    publish_result(hub, result);
}

/// Publishes why a run has ended without a result. The error describes what was saved.
pub(super) fn publish_failure(hub: &Hub, error: &anyhow::Error) {
    let result = RunResult {
        verdict: Some(Verdict {
            grade: Grade::Unknown,
            text: "The run ended with an error".to_owned(),
        }),
        problems: vec![format!("{error:#}")],
        ..RunResult::default()
    };
    publish_result(hub, result);
}

/// Publishes a result, and waits until connected clients have received it. They keep showing it
/// after the server has stopped.
fn publish_result(hub: &Hub, result: RunResult) {
    hub.change_status(remove_pending_checkpoint);
    hub.set_run_result(result);
    if hub.n_clients() > 0 {
        std::thread::sleep(FINAL_STATUS_TIME);
    }
}

/// Removes a pending checkpoint request from the status. At the end of a run, the last checkpoint
/// is written instead, so the state of the request would never change.
fn remove_pending_checkpoint(status: &mut Status) {
    let is_pending =
        |checkpoint: &mut RequestedCheckpoint| checkpoint.state == CheckpointState::Requested;
    if let Some(RequestedCheckpoint { text, .. }) = status.operator.checkpoint.take_if(is_pending) {
        status.notes.retain(|note| *note != text);
        status.operator.infos.retain(|note| *note != text);
    }
}

/// Replaces the last scores of the training by those of the saved models, so that the page shows
/// the PSNR of the verdict.
///
/// * `scores`: name of the method, training time in seconds, and PSNR of each scored model.
fn publish_final_scores<'a>(hub: &Hub, scores: impl Iterator<Item = (&'a str, f64, f64)> + Clone) {
    hub.change_status(|status| {
        for shown in std::iter::once(&mut status.model).chain(&mut status.others) {
            let of_model = scores.clone().find(|(name, ..)| *name == shown.method);
            if let Some((_, seconds, psnr)) = of_model {
                shown.psnr = Some(psnr);
                shown.psnr_history.push((seconds, psnr));
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use viz::{ModelStatus, OperatorStatus};

    #[test]
    fn page_shows_the_final_scores() {
        let hub = Hub::new();
        let model = |method: &str, psnr| ModelStatus {
            method: method.to_owned(),
            psnr: Some(psnr),
            psnr_history: vec![(8.0, psnr)],
            ..ModelStatus::default()
        };
        hub.set_status(Status {
            model: model("splat", 25.2),
            others: vec![model("tsdf", 18.0)],
            ..Status::default()
        });
        publish_final_scores(&hub, [("splat", 10.0, 24.85)].into_iter());
        hub.change_status(|status| {
            assert_eq!(status.model.psnr, Some(24.85));
            assert_eq!(status.model.psnr_history, [(8.0, 25.2), (10.0, 24.85)]);
            assert_eq!(status.others, [model("tsdf", 18.0)], "it was not scored");
        });
    }

    #[test]
    fn a_requested_checkpoint_does_not_stay_pending_after_the_run() {
        for (state, is_kept) in [
            (CheckpointState::Requested, false),
            (CheckpointState::Failed, true),
        ] {
            let text = "checkpoint".to_owned();
            let mut status = Status {
                notes: vec![text.clone(), "no GPU".to_owned()],
                operator: OperatorStatus {
                    infos: vec![text.clone()],
                    checkpoint: Some(RequestedCheckpoint { state, text }),
                    ..OperatorStatus::default()
                },
                ..Status::default()
            };
            remove_pending_checkpoint(&mut status);
            assert_eq!(status.operator.checkpoint.is_some(), is_kept);
            assert_eq!(status.operator.infos.is_empty(), !is_kept);
            assert_eq!(status.notes.len(), if is_kept { 2 } else { 1 });
        }
    }
}
