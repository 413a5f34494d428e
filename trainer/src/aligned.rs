//! A scene model whose cameras are aligned before they are believed.
//!
//! Alignment runs beside learning, and where that keeps something, the model begins anew with corrected keyframes. Splats, which try out more about cameras, have alignment of their own.

use crate::align::{Aligning, Alignment, taken_at};
use crate::checkpoint::{Checkpoint, PendingCheckpoint};
use crate::gpu::PassTiming;
use crate::splat::{CameraChoice, CameraFix, PosedLens, read_about};
use crate::{Error, Keyframe, Method, Part, Picture, Progress, RenderRequest};
use kinematics::Stamp;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;

/// Key of what is known about cameras in the state of a checkpoint, and in `model.json`.
const STATE_KEY: &str = "aligned";
const ABOUT_KEY: &str = "alignment";

/// A model that can begin anew.
pub trait Renewable: Method {
    /// Forgets all keyframes and all that was learned; what is compiled may stay.
    fn begin_anew(&mut self) -> Result<(), Error>;
    /// What was learned about a camera along with the scene, from keyframes as they are pushed; none where nothing is.
    fn learned_fix(&mut self, _camera: &str) -> Result<Option<CameraFix>, Error> {
        Ok(None)
    }
}

/// A model that goes on from a checkpoint, and the keyframes that it had not learned from.
pub type WithRest = (Box<dyn Method>, Vec<Arc<Keyframe>>);

/// A model, and what is known about the cameras of its keyframes.
#[derive(Debug)]
pub struct Aligned<M> {
    model: M,
    choice: CameraChoice,
    aligning: Aligning,
    /// As they came, until alignment is settled.
    given: Vec<Arc<Keyframe>>,
    taken_at: u64,
    /// Updates of the model before it began anew.
    n_before: u64,
}

/// What a checkpoint says about cameras.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    choice: CameraChoice,
    is_settled: bool,
    alignment: Option<Alignment>,
    taken_at: u64,
    n_before: u64,
}

impl<M: Renewable + 'static> Aligned<M> {
    /// A model whose keyframes are aligned as `choice` says; the result is taken early in `n_planned_steps`.
    pub fn new(model: M, choice: CameraChoice, is_software: bool, n_planned_steps: u64) -> Self {
        let (aligning, taken_at) = (Aligning::new(&choice), taken_at(is_software, n_planned_steps));
        Self { model, choice, aligning, given: Vec::new(), taken_at, n_before: 0 }
    }

    /// A saved model, with what its folder knows about cameras.
    pub fn of_folder(model: M, folder: &Path) -> Result<Self, Error> {
        let aligning = Aligning::Done(read_about(&folder.join("model.json"))?.alignment);
        Ok(Self { model, choice: CameraChoice::default(), aligning, given: Vec::new(), taken_at: 0, n_before: 0 })
    }

    /// Goes on from a checkpoint with `resume`, which finds the keyframes among those it is given, each as it was learned
    /// from.
    pub fn resume(
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
        resume: impl FnOnce(&Checkpoint, &[Arc<Keyframe>]) -> Result<(M, Vec<Arc<Keyframe>>), Error>,
    ) -> Result<WithRest, Error> {
        let mut own = checkpoint.clone();
        let Some(state) = own.state.as_object_mut().and_then(|state| state.remove(STATE_KEY)) else {
            let (model, rest) = resume(checkpoint, keyframes)?;
            return Ok((Box::new(model), rest));
        };
        let bad = |error: serde_json::Error| Error::CheckpointState { reason: error.to_string() };
        let State { choice, is_settled, alignment, taken_at, n_before } = serde_json::from_value(state).map_err(bad)?;
        let aligning = if is_settled { Aligning::Done(alignment) } else { Aligning::new(&choice) };
        let corrected: Vec<_> = keyframes.iter().map(|keyframe| aligning.corrected(keyframe)).collect();
        let (model, rest) = resume(&own, &corrected)?;
        // What is pushed again is corrected again.
        let is_rest = |keyframe: &Arc<Keyframe>| {
            rest.iter().any(|other| (&other.camera, other.stamp) == (&keyframe.camera, keyframe.stamp))
        };
        let (as_given, learned): (Vec<_>, Vec<_>) = keyframes.iter().cloned().partition(is_rest);
        let given = if is_settled { Vec::new() } else { learned };
        Ok((Box::new(Self { model, choice, aligning, given, taken_at, n_before }), as_given))
    }

    /// Takes what alignment found, and begins anew where that is anything.
    fn settle(&mut self) -> Result<(), Error> {
        let is_any = self.aligning.finish()?;
        let given = std::mem::take(&mut self.given);
        if !is_any {
            return Ok(());
        }
        log::info!("training begins anew with corrected cameras");
        self.n_before += self.model.n_taken()?;
        self.model.begin_anew()?;
        given.iter().try_for_each(|keyframe| self.model.push(self.aligning.corrected(keyframe)))
    }
}

impl<M: Renewable + 'static> Method for Aligned<M> {
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        let corrected = self.aligning.corrected(&keyframe);
        if !self.aligning.is_done() {
            self.given.push(keyframe);
        }
        self.model.push(corrected)
    }

    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        self.given.retain(|keyframe| keyframe.camera.as_ref() != camera || keyframe.stamp != stamp);
        self.model.remove(camera, stamp)
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        let step = self.model.progress().step;
        let is_running = !self.aligning.is_done() && !self.aligning.is_asked();
        if is_running && (step >= self.taken_at || self.model.is_idle()) {
            self.settle()?;
        }
        let left =
            if self.aligning.is_done() { u64::MAX } else { self.taken_at.saturating_sub(self.model.progress().step) };
        let n_steps = self.model.step(n.min(left))?;
        // After the first step, which has much to do on the processor itself.
        if self.aligning.is_asked() && n_steps > 0 {
            self.aligning.begin(self.given.clone(), &self.choice);
        }
        Ok(n_steps)
    }

    fn is_idle(&self) -> bool {
        self.model.is_idle() && (self.aligning.is_done() || self.model.progress().step == 0)
    }

    fn primitive(&self) -> &'static str {
        self.model.primitive()
    }

    fn n_taken(&mut self) -> Result<u64, Error> {
        Ok(self.n_before + self.model.n_taken()?)
    }

    fn seed(&mut self) -> Result<(), Error> {
        self.model.seed()
    }

    fn prepare(&mut self) -> Result<(), Error> {
        self.model.prepare()
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        self.model.render(request)
    }

    fn set_watched(&mut self, watched: bool) {
        self.model.set_watched(watched);
    }

    fn psnr(&mut self, request: &RenderRequest, keyframe: &Keyframe) -> Result<Option<f64>, Error> {
        self.model.psnr(request, keyframe)
    }

    fn depth_stride(&self) -> u32 {
        self.model.depth_stride()
    }

    fn posed_lens(&mut self, keyframe: &Keyframe) -> Result<PosedLens, Error> {
        let learned = self.model.learned_fix(&keyframe.camera)?;
        Ok(self.aligning.posed_lens(keyframe, learned.as_ref()))
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.model.profile_step()
    }

    fn alignment(&self) -> Option<&Alignment> {
        self.aligning.result()
    }

    fn progress(&self) -> Progress {
        self.model.progress()
    }

    fn report(&self) -> Vec<Part> {
        self.model.report()
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.model.save(folder)?;
        let Some(alignment) = self.aligning.result() else { return Ok(()) };
        let path = folder.join("model.json");
        let refused = |error: serde_json::Error| Error::SplatFile { path: path.clone(), reason: error.to_string() };
        let bytes = std::fs::read(&path).map_err(|source| Error::Read { path: path.clone(), source })?;
        let mut about: serde_json::Map<String, serde_json::Value> = serde_json::from_slice(&bytes).map_err(refused)?;
        about.insert(ABOUT_KEY.to_owned(), serde_json::to_value(alignment).map_err(refused)?);
        let text = format!("{:#}\n", serde_json::Value::Object(about));
        std::fs::write(&path, text).map_err(|source| Error::Write { path: path.clone(), source })
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        let state = State {
            choice: self.choice.clone(),
            is_settled: self.aligning.is_done(),
            alignment: self.aligning.result().cloned(),
            taken_at: self.taken_at,
            n_before: self.n_before,
        };
        let bad = |error: serde_json::Error| Error::CheckpointState { reason: error.to_string() };
        let state = serde_json::to_value(state).map_err(bad)?;
        let pending = self.model.checkpoint()?;
        Ok(PendingCheckpoint::new(move || {
            let mut checkpoint = pending.finish()?;
            if let Some(all) = checkpoint.state.as_object_mut() {
                all.insert(STATE_KEY.to_owned(), state);
            }
            Ok(checkpoint)
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::tests::{Wrong, capture, left, wrong_mount};
    use crate::gpu::{Gpu, GpuOptions};
    use crate::nerf::{Effort, NerfModel, NerfOptions};
    use crate::splat::TermSet;
    use crate::tsdf::{TsdfModel, TsdfOptions};
    use crate::{Split, test_scenes as scenes};

    /// The step at which the result is taken.
    const TAKEN_AT: u64 = 6;
    const MOUNT: TermSet = TermSet { mount: true, ..TermSet::NONE };

    fn tsdf(gpu: &Arc<Gpu>) -> TsdfModel {
        TsdfModel::new(gpu.clone(), TsdfOptions::default()).unwrap()
    }

    fn nerf(gpu: &Arc<Gpu>) -> NerfModel {
        let effort = Effort { n_rays: 64, n_samples: 1 << 10, n_cells: 32, most_log2_entries: 10, ..Effort::SMALL };
        let options = NerfOptions { effort: Some(effort), n_planned_steps: 4 * TAKEN_AT, ..NerfOptions::default() };
        NerfModel::new(gpu.clone(), options).unwrap()
    }

    type Resume<M> = fn(Arc<Gpu>, &Checkpoint, &[Arc<Keyframe>]) -> Result<(M, Vec<Arc<Keyframe>>), Error>;

    fn learn(model: &mut dyn Method, n_steps: u64) {
        for _ in 0..n_steps {
            model.step(1).unwrap();
        }
    }

    #[test]
    fn models_begin_anew_with_corrected_cameras_and_stopping_in_between_changes_nothing() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        begins_anew(&gpu, tsdf(&gpu), TsdfModel::resume, TsdfModel::load);
        begins_anew(&gpu, nerf(&gpu), NerfModel::resume, NerfModel::load);
    }

    fn begins_anew<M: Renewable + 'static>(
        gpu: &Arc<Gpu>,
        model: M,
        resume: Resume<M>,
        load: fn(Arc<Gpu>, &Path) -> Result<M, Error>,
    ) {
        let wrong = Wrong { mount: wrong_mount(), ..Wrong::nothing() };
        let keyframes = capture(&wrong);
        let test = keyframes.iter().find(|keyframe| keyframe.split == Split::Test).unwrap();
        let mut whole = Aligned::new(model, CameraChoice::Given(MOUNT), true, 4 * TAKEN_AT);
        keyframes.iter().for_each(|keyframe| whole.push(keyframe.clone()).unwrap());
        learn(&mut whole, TAKEN_AT - 2);
        let early = whole.checkpoint().unwrap().finish().unwrap();
        learn(&mut whole, 2);
        assert!(whole.alignment().is_none() && whole.progress().step == TAKEN_AT);
        learn(&mut whole, 1);
        assert_eq!((whole.progress().step, whole.n_taken().unwrap()), (1, TAKEN_AT + 1), "it began anew");
        let fix = whole.alignment().unwrap().fixes["wrist"].clone();
        let (degrees, mm) = left(&fix, &wrong.mount);
        assert!(degrees < 0.05 && mm < 0.5, "{degrees} degrees, {mm} mm");
        assert_eq!(whole.posed_lens(test).unwrap(), fix.apply(test));
        learn(&mut whole, 2);

        let resumed = |checkpoint: &Checkpoint| {
            Aligned::resume(checkpoint, &keyframes, |own, keyframes| resume(gpu.clone(), own, keyframes)).unwrap()
        };
        let (mut parts, rest) = resumed(&early);
        let is_given = |keyframe: &Arc<Keyframe>| keyframes.iter().any(|given| Arc::ptr_eq(given, keyframe));
        assert!(!rest.is_empty() && rest.iter().all(is_given));
        rest.into_iter().for_each(|keyframe| parts.push(keyframe).unwrap());
        learn(&mut *parts, 3);
        let (mut parts, rest) = resumed(&parts.checkpoint().unwrap().finish().unwrap());
        rest.into_iter().for_each(|keyframe| parts.push(keyframe).unwrap());
        learn(&mut *parts, 2);
        let [whole_end, parts_end] =
            [&mut whole as &mut dyn Method, &mut *parts].map(|model| model.checkpoint().unwrap().finish().unwrap());
        assert_eq!(whole_end, parts_end);

        let folder = tempfile::tempdir().unwrap();
        whole.save(folder.path()).unwrap();
        let loaded = || Aligned::of_folder(load(gpu.clone(), folder.path()).unwrap(), folder.path()).unwrap();
        assert_eq!(loaded().posed_lens(test).unwrap(), fix.apply(test));
        std::fs::remove_file(folder.path().join("model.json")).unwrap();
        assert_eq!(loaded().posed_lens(test).unwrap(), PosedLens::of(test), "nothing is known without the file");
    }

    #[test]
    fn nothing_to_learn_from_is_idle_and_what_cannot_be_aligned_goes_on() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        goes_on(tsdf(&gpu));
        goes_on(nerf(&gpu));
    }

    fn goes_on<M: Renewable + 'static>(model: M) {
        let mut model = Aligned::new(model, CameraChoice::Given(MOUNT), true, 4 * TAKEN_AT);
        assert!(model.is_idle());
        for keyframe in scenes::ring(&[scenes::floor()], nalgebra::Point3::origin(), 2) {
            model.push(keyframe).unwrap();
        }
        while !model.is_idle() && model.progress().step < TAKEN_AT + 2 {
            model.step(1).unwrap();
        }
        assert!(model.alignment().is_none_or(|alignment| !alignment.is_any()));
        assert!(model.progress().step > 0);
    }
}
