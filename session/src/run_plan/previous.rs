//! A live run that another run continues, with its keyframes.

use crate::previous_run::PreviousRun;
use crate::stored_keyframes::StoredKeyframes;
use crate::training_options::REALIGN;
use anyhow::Context;
use capture::config::Override;
use gpu::Gpu;
use keyframe::Keyframe;
use messages::counted;
use std::path::Path;
use std::sync::Arc;
use trainer::{ModelKind, Resumed};

/// A live run to continue.
pub struct PreviousLiveRun {
    pub(super) run: PreviousRun,
    /// Keyframes of the previous run, ordered by stamp.
    pub(super) keyframes: Vec<Arc<Keyframe>>,
}

impl PreviousLiveRun {
    /// Reads the checkpoint and the keyframes in the folder of a run.
    pub(super) fn read(folder: &Path) -> anyhow::Result<Self> {
        let run = PreviousRun::read(folder)?;
        let stored = StoredKeyframes::of_run(folder).read();
        let keyframes = stored.with_context(|| {
            format!(
                "the run in {} has no usable keyframes; to continue from a recording, use `fieldrig train`",
                folder.display()
            )
        })?;
        log::info!(
            "continuing the run in {} after {:.1} s, with {}",
            folder.display(),
            run.checkpoint.seconds,
            counted(keyframes.len() as u64, "keyframe")
        );
        Ok(Self { run, keyframes })
    }

    /// Restores the model of the previous run, without the keyframes that cannot be read.
    pub(super) fn resume(&self, gpu: &Arc<Gpu>) -> anyhow::Result<Resumed> {
        let (resumed, missing) =
            trainer::resume_without_missing(gpu.clone(), &self.run.checkpoint, &self.keyframes)?;
        if let Some((camera, stamp)) = missing.first() {
            log::warn!(
                "{} of the earlier run {} missing, the first of camera {camera:?} at {} ns: training continues without them, \
                 but their effect on the model so far remains",
                counted(missing.len() as u64, "keyframe"),
                if missing.len() == 1 { "is" } else { "are" },
                stamp.0
            );
        }
        Ok(resumed)
    }

    /// Rig file settings that flags of the previous run have changed.
    pub(super) fn overrides(&self) -> Vec<Override> {
        let realign = self
            .run
            .flag(REALIGN)
            .map(|is_on| Override::new(REALIGN, is_on == "true"));
        let method = ModelKind::from_name(&self.run.checkpoint.method)
            .map(|kind| Override::new("train.method", kind.name()));
        realign.into_iter().chain(method).collect()
    }
}
