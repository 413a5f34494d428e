//! The persistent state of a session: checkpoints for resuming, a decision log for replaying, and
//! data for continuing on another device.

use crate::checkpoints::{self, CheckpointProgress, CheckpointWrite, Checkpoints, Snapshot};
use crate::decisions::DecisionLog;
use crate::error::is_gpu_error;
use crate::kept_folder::KeptFolder;
use crate::recovery::Recovery;
use gpu::Gpu;
use keyframe::{DepthMap, Keyframe};
use kinematics::Stamp;
use messages::Setting;
use model_files::checkpoint::Checkpoint;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use trainer::{AlignedModel, Resumed};

/// Checkpoints, decision log and recovery data of a session.
pub struct Persistence {
    checkpoints: Option<Checkpoints>,
    decisions: Option<DecisionLog>,
    recovery: Option<Recovery>,
    folders: Vec<KeptFolder>,
    /// Evicted keyframes, without pixels, that the newest complete checkpoint may contain. The
    /// first `n_evicted_before_last` of them were evicted before the last checkpoint was started.
    evicted: Vec<Arc<Keyframe>>,
    n_evicted_before_last: usize,
}

impl Persistence {
    /// The persistent state of a new session. Without checkpoints, decisions or recovery, it writes
    /// none of them. The folders are made again if they disappear.
    pub(super) fn new(
        checkpoints: Option<Checkpoints>,
        decisions: Option<DecisionLog>,
        recovery: Option<Recovery>,
        folders: Vec<KeptFolder>,
    ) -> Self {
        Self {
            checkpoints,
            decisions,
            recovery,
            folders,
            evicted: Vec::new(),
            n_evicted_before_last: 0,
        }
    }

    /// Checks the folders, at most once per second.
    pub(super) fn check_folders_when_due(&mut self) {
        self.folders.iter_mut().for_each(KeptFolder::check_when_due);
    }

    /// Makes the folders of the run again if they have disappeared.
    pub fn check_folders(&mut self) {
        self.folders.iter_mut().for_each(KeptFolder::check);
    }

    /// Logs that a keyframe was pushed to the model.
    pub(super) fn log_push(
        &mut self,
        method: &mut AlignedModel,
        keyframe: &Arc<Keyframe>,
    ) -> anyhow::Result<()> {
        if let Some(decisions) = &mut self.decisions {
            decisions.pushed(method.n_total_steps()?, keyframe);
        }
        Ok(())
    }

    /// Logs that a keyframe was removed from the model.
    pub(super) fn log_removal(
        &mut self,
        method: &mut AlignedModel,
        camera: &str,
        stamp: Stamp,
    ) -> anyhow::Result<()> {
        if let Some(decisions) = &mut self.decisions {
            decisions.removed(method.n_total_steps()?, camera, stamp);
        }
        Ok(())
    }

    /// Logs that the result of an alignment was applied.
    pub(super) fn log_alignment(&mut self, method: &mut AlignedModel) -> anyhow::Result<()> {
        if let Some(decisions) = &mut self.decisions {
            decisions.aligned(method.n_total_steps()?);
        }
        Ok(())
    }

    /// Logs that growth was paused or continued.
    pub(super) fn log_growth_pause(
        &mut self,
        method: &mut AlignedModel,
        is_paused: bool,
    ) -> anyhow::Result<()> {
        if let Some(decisions) = &mut self.decisions {
            decisions.growth_paused(method.n_total_steps()?, is_paused);
        }
        Ok(())
    }

    /// Logs that a picture is drawn. Drawing affects the result, because it creates splats for new
    /// keyframes.
    pub(super) fn log_render(&mut self) {
        if let Some(decisions) = &mut self.decisions {
            decisions.seeded();
        }
    }

    /// Logs that training steps were requested.
    pub(super) fn log_step_request(&mut self) {
        if let Some(decisions) = &mut self.decisions {
            decisions.step_requested();
        }
    }

    /// Ends the decision log. Write errors are logged.
    pub(super) fn end_decisions(&mut self, method: &mut AlignedModel) -> anyhow::Result<()> {
        if let Some(decisions) = self.decisions.take()
            && let Err(error) = decisions.end(method.n_total_steps()?)
        {
            log::warn!("{error:#}");
        }
        Ok(())
    }

    /// Keeps an evicted keyframe, without pixels, as long as the newest checkpoint may contain it.
    pub(super) fn evict(&mut self, keyframe: &Keyframe) {
        // The keyframe is kept without pixels, because eviction must free memory in a long run.
        if self.recovery.is_some() {
            self.evicted.push(Arc::new(without_pixels(keyframe)));
        }
    }

    /// Stores a keyframe again, because its pose was revised.
    pub(super) fn store_again(&mut self, keyframe: &Arc<Keyframe>) {
        if let Some(checkpoints) = &mut self.checkpoints {
            checkpoints.store_again(keyframe);
        }
    }

    /// Sets how many images did not become keyframes so far, by reason, for the next checkpoint.
    pub(crate) fn set_rejected(&mut self, rejected: &BTreeMap<String, u64>) {
        if let Some(checkpoints) = &mut self.checkpoints {
            checkpoints.set_rejected(rejected);
        }
    }

    /// Makes the next checkpoint due now. Returns false if the run writes no checkpoints.
    pub(crate) fn request_checkpoint(&mut self) -> bool {
        self.checkpoints
            .as_mut()
            .map(Checkpoints::request)
            .is_some()
    }

    /// What has become of the last requested checkpoint; `None` if none was requested.
    pub(crate) fn requested_checkpoint(&mut self) -> Option<&CheckpointProgress> {
        self.checkpoints.as_mut()?.requested()
    }

    /// Starts a checkpoint if one is due.
    pub(super) fn write_checkpoint_when_due(
        &mut self,
        snapshot: Snapshot<'_>,
    ) -> anyhow::Result<()> {
        let Some(checkpoints) = &mut self.checkpoints else {
            return Ok(());
        };
        // Borrowed again for the snapshot, because the step is read after it.
        let method = snapshot.method;
        if checkpoints.write_when_due(Snapshot {
            method: &mut *method,
            ..snapshot
        })? {
            if let Some(decisions) = &mut self.decisions {
                decisions.checkpoint(method.n_total_steps()?);
            }
            // Until this checkpoint is on disk, the previous one is the newest. Neither contains
            // keyframes that were evicted before the previous one.
            self.evicted.drain(..self.n_evicted_before_last);
            self.n_evicted_before_last = self.evicted.len();
        }
        Ok(())
    }

    /// Whether keyframes are stored with the checkpoints, as in a live run, which has no other copy
    /// of them.
    pub(super) fn keeps_keyframes(&self) -> bool {
        self.checkpoints
            .as_ref()
            .is_some_and(Checkpoints::keeps_keyframes)
    }

    /// Copies the final state for [`Self::write_checkpoint`]. Errors are only logged, so that the
    /// model is still saved.
    pub(super) fn take_last_checkpoint(
        &mut self,
        snapshot: Snapshot<'_>,
    ) -> Option<CheckpointWrite> {
        match self
            .checkpoints
            .as_mut()
            .map(|checkpoints| checkpoints.take(snapshot))
            .transpose()
        {
            Ok(checkpoint) => checkpoint,
            Err(error) => {
                log::warn!("cannot write a checkpoint of the final state: {error:#}");
                None
            }
        }
    }

    /// Writes a copy of the final state on a separate thread.
    pub(super) fn write_checkpoint(&mut self, checkpoint: Option<CheckpointWrite>) {
        if let (Some(checkpoints), Some(checkpoint)) = (&mut self.checkpoints, checkpoint) {
            checkpoints.write(checkpoint);
        }
    }

    /// Whether a checkpoint or keyframes are being written on a separate thread.
    pub(super) fn is_writing(&self) -> bool {
        self.checkpoints
            .as_ref()
            .is_some_and(Checkpoints::is_writing)
    }

    /// Waits until no checkpoint is being written, and returns the error of the last one.
    pub(super) fn wait(&mut self) -> anyhow::Result<()> {
        self.checkpoints.as_mut().map_or(Ok(()), Checkpoints::wait)
    }

    /// Waits until no checkpoint is being written.
    pub fn wait_for_checkpoint(&mut self) {
        if let Err(error) = self.wait() {
            log::debug!("the last checkpoint was not written: {error:#}");
        }
    }

    /// Whether a model can be restored on another device.
    pub(crate) fn can_restore(&self) -> bool {
        self.recovery.is_some()
    }

    /// Describes how to continue if the run fails now, as a sentence without a period; `None`
    /// without recovery.
    pub(crate) fn describe_recoverable(&mut self) -> Option<String> {
        let has_checkpoint = self.has_checkpoint();
        Some(self.recovery.as_ref()?.describe_recoverable(has_checkpoint))
    }

    /// Describes how to continue if the model could not be saved, as a clause for an error message.
    pub(super) fn describe_unsaved(&mut self) -> String {
        match self.describe_recoverable() {
            Some(left) if self.has_checkpoint() => {
                format!(
                    "{left}; use {} to save the model in another folder",
                    Setting::Out
                )
            }
            Some(left) => left,
            None => "there is no checkpoint either".to_owned(),
        }
    }

    /// Whether this run has written a checkpoint.
    fn has_checkpoint(&mut self) -> bool {
        self.checkpoints
            .as_mut()
            .is_some_and(|checkpoints| checkpoints.newest().is_some())
    }

    /// Restores the model with these keyframes on another device, from the newest checkpoint or
    /// else from scratch. Begins a new decision log.
    pub(super) fn restore(
        &mut self,
        gpu: &Arc<Gpu>,
        keyframes: &[Arc<Keyframe>],
    ) -> anyhow::Result<AlignedModel> {
        let Some(recovery) = &self.recovery else {
            anyhow::bail!("this run cannot continue on another device")
        };
        let checkpoint = newest_checkpoint(self.checkpoints.as_mut(), recovery.resumed.as_deref());
        // A checkpoint requires all keyframes that its model was trained on, including those that
        // were evicted after it was taken. Their descriptions are enough.
        let held: Vec<Arc<Keyframe>> = recovery.known.iter().chain(keyframes).cloned().collect();
        let all = [&held[..], &self.evicted[..]].concat();
        let resumed = checkpoint.map_or(Ok(None), |checkpoint| resume(gpu, checkpoint, &all))?;
        let is_resumed = resumed.is_some();
        let (mut method, untrained) = match resumed {
            Some(resumed) => (resumed.method, resumed.untrained),
            None => (recovery.model_spec.start(gpu.clone())?, held.clone()),
        };
        // Kernels are compiled here, so that this time does not count as training time.
        method.model_mut().prepare()?;
        // Evictions since the checkpoint are repeated. They include keyframes that are not in the
        // store of the model, because it was never trained on them.
        for keyframe in self
            .evicted
            .iter()
            .filter(|keyframe| !contains(&untrained, keyframe))
        {
            method.remove(&keyframe.camera, keyframe.stamp)?;
        }
        let from_step = method.n_total_steps()?;
        // The current log ends here. The new log may have the same file name and then replaces it.
        if let Some(decisions) = self.decisions.take() {
            decisions.close_unfinished();
        }
        let settings = recovery
            .settings
            .continued_from(is_resumed.then_some(from_step));
        let mut decisions = DecisionLog::create(&recovery.folder, settings)?;
        held.iter()
            .filter(|keyframe| !contains(&untrained, keyframe))
            .for_each(|keyframe| decisions.restored(from_step, keyframe));
        // These keyframes arrived after the checkpoint. Keyframes that were evicted since then are
        // also untrained, and are left out.
        for keyframe in untrained
            .iter()
            .filter(|keyframe| contains(&held, keyframe))
        {
            method.push(keyframe.clone())?;
            decisions.pushed(method.n_total_steps()?, keyframe);
        }
        log::info!(
            "reopened the GPU: training continues from {}",
            if is_resumed {
                format!("the checkpoint of step {from_step}")
            } else {
                "the start".to_owned()
            }
        );
        self.decisions = Some(decisions);
        Ok(method)
    }
}

/// The newest checkpoint. If this run has not written one, this is the checkpoint from which the
/// run was resumed. `None` if there is no checkpoint.
fn newest_checkpoint(
    checkpoints: Option<&mut Checkpoints>,
    resumed_folder: Option<&Path>,
) -> Option<anyhow::Result<Checkpoint>> {
    match (checkpoints.and_then(Checkpoints::newest), resumed_folder) {
        (Some(path), _) => Some(Checkpoint::read(path).map_err(anyhow::Error::from)),
        (None, Some(folder)) => Some(checkpoints::read(folder)),
        (None, None) => None,
    }
}

/// Whether a list contains this very keyframe, not only one with the same camera and stamp.
fn contains(keyframes: &[Arc<Keyframe>], keyframe: &Arc<Keyframe>) -> bool {
    keyframes.iter().any(|other| Arc::ptr_eq(other, keyframe))
}

/// Resumes a model from a checkpoint. Returns `None` if the checkpoint cannot be used, and an error
/// if the GPU failed.
fn resume(
    gpu: &Arc<Gpu>,
    checkpoint: anyhow::Result<Checkpoint>,
    keyframes: &[Arc<Keyframe>],
) -> anyhow::Result<Option<Resumed>> {
    // Keyframes that were missing at the start of this run are still missing.
    let resume = |checkpoint| {
        Ok(trainer::resume_without_missing(
            gpu.clone(),
            &checkpoint,
            keyframes,
        )?)
    };
    match checkpoint.and_then(resume) {
        Ok((resumed, _)) => Ok(Some(resumed)),
        // The new device has failed, too: the caller tries again.
        Err(error) if is_gpu_error(&error) => Err(error),
        // The checkpoint is unusable, for example damaged. Starting again loses training time, but
        // an error would lose the run.
        Err(error) => {
            log::warn!("cannot resume from the newest checkpoint: {error:#}");
            Ok(None)
        }
    }
}

/// A copy of a keyframe without pixels, with all data that identifies the keyframe in a checkpoint.
fn without_pixels(keyframe: &Keyframe) -> Keyframe {
    let depth = keyframe.depth.as_ref().map(|depth| DepthMap {
        depth_m: [].into(),
        ..depth.clone()
    });
    Keyframe {
        rgba_srgb: [].into(),
        depth,
        truth: None,
        ..keyframe.clone()
    }
}
