//! One model in training: its keyframes, its clock, and what is told of it.

use crate::bench::statistics::median;
use crate::checkpoints::Checkpoints;
use crate::clock::Clock;
use crate::decisions::DecisionLog;
use crate::evaluate::{Evaluator, ImageScores, Scores};
use crate::marks::Marks;
use crate::method::Kind;
use crate::stop::Stop;
use crate::turns::TURN;
use crate::{print, run_folder};
use indicatif::ProgressBar;
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::align::Alignment;
use trainer::gpu::{Gpu, PassTiming};
use trainer::{Keyframe, Method, Part, Picture, Progress, RenderRequest, Split};

/// Steps that a profile is the median of.
const N_PROFILED: usize = 21;
/// After large buffers were let go of, drivers are slow for a while.
const BEFORE_PROFILE: Duration = Duration::from_millis(700);
/// Where drawing takes longer, a mark scores fewer test images: a neural field takes seconds for each on a processor.
const MOST_SCORING_AT_MARKS: Duration = Duration::from_secs(60);
/// Points of the PSNR curve that are kept; past them every second one goes.
const MAX_HISTORY: usize = 512;

/// When to stop.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Limits {
    /// Seconds on the session's clock.
    pub(crate) seconds: Option<f64>,
    /// Optimiser updates.
    pub(crate) steps: Option<u64>,
}

impl Limits {
    /// How long that is, for people: `8 s`, `500 steps`.
    pub(crate) fn in_words(self) -> String {
        let parts =
            [self.seconds.map(|seconds| format!("{seconds} s")), self.steps.map(|steps| format!("{steps} steps"))];
        parts.into_iter().flatten().collect::<Vec<_>>().join(" or ")
    }
}

/// How a session is judged.
#[derive(Clone)]
pub(crate) struct Evaluators {
    /// At the marks: thorough where nobody waits, quick in a live run.
    pub(crate) at_marks: Evaluator,
    /// Test keyframes scored at a mark, spread evenly over all; the others are scored at the end only.
    pub(crate) most_at_marks: usize,
    /// At the end.
    pub(crate) at_end: Evaluator,
}

/// What a session prints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Tell {
    /// A line a mark, and a bar where stderr is a terminal.
    Lines,
    /// One JSON object a mark.
    Json,
    /// Nothing but the bar: the caller tells what came of it.
    Bar,
    /// Nothing at all.
    Nothing,
}

impl Tell {
    /// What a command prints of its one session.
    pub(crate) fn of_command(json: bool) -> Self {
        if json { Self::Json } else { Self::Lines }
    }
}

/// A model in training.
pub(crate) struct Session {
    kind: Kind,
    method: Box<dyn Method>,
    checkpoints: Option<Checkpoints>,
    decisions: Option<DecisionLog>,
    gpu: Arc<Gpu>,
    /// At the marks.
    evaluator: Evaluator,
    most_at_marks: usize,
    /// At the end.
    last_evaluator: Evaluator,
    /// Held, in the order they came.
    keyframes: Vec<Arc<Keyframe>>,
    tests: VecDeque<Arc<Keyframe>>,
    limits: Limits,
    clock: Clock,
    /// Time it had on a device that it shares.
    had: Duration,
    /// When it was done though others were not, seconds.
    rested_secs: Option<f64>,
    marks: Marks,
    told: Vec<Eval>,
    history: Vec<(f64, f64)>,
    /// Newest PSNR of each test keyframe, by camera and stamp.
    newest_psnr: BTreeMap<(String, i64), f64>,
    tell: Tell,
    /// Whether somebody wants an end: a mark is not worth waiting for then.
    stop: Stop,
    profiles: bool,
    bar: ProgressBar,
}

/// What is told at a mark.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Eval {
    event: &'static str,
    method: &'static str,
    pub(crate) seconds: f64,
    pub(crate) step: u64,
    #[serde(flatten)]
    pub(crate) scores: Scores,
    /// Test images that the scores are means over.
    n_images: usize,
    pub(crate) primitives: u64,
    pub(crate) bytes: u64,
    step_millis: Option<f64>,
}

/// What came of a training.
pub(crate) struct Outcome {
    pub(crate) seconds: f64,
    pub(crate) steps: u64,
    pub(crate) scores: Scores,
    pub(crate) primitives: u64,
    pub(crate) bytes: u64,
    /// What was told at the marks.
    pub(crate) marks: Vec<Eval>,
    per_image: Vec<ImageScores>,
}

/// What is told at the end.
#[derive(Clone, Debug, Serialize)]
struct Done<'a> {
    event: &'static str,
    method: &'static str,
    seconds: f64,
    steps: u64,
    #[serde(flatten)]
    scores: Scores,
    primitives: u64,
    bytes: u64,
    out: &'a Path,
    checkpoint_sha256: &'a str,
}

/// GPU time of each kernel in a step, milliseconds.
#[derive(Debug, Serialize)]
struct Profile<'a> {
    event: &'static str,
    method: &'static str,
    passes: &'a [(&'static str, f64)],
}

/// What `report.json` holds.
#[derive(Debug, Serialize)]
struct Report<'a, T: Serialize> {
    done: &'a Done<'a>,
    adapter: String,
    #[serde(flatten)]
    particulars: &'a T,
    /// What the parts of the model that were tried bought.
    parts: Vec<Part>,
    /// GPU time of each pass of a step, milliseconds, where it was asked for.
    passes: Vec<(&'static str, f64)>,
    marks: &'a [Eval],
    per_image: &'a [ImageScores],
}

/// One of the sessions that end together: where its results go, and what only its kind of run knows of it.
pub(crate) struct Ending<P> {
    pub(crate) session: Session,
    pub(crate) out: PathBuf,
    pub(crate) particulars: P,
}

/// Saves the models; then scores each a last time, writes its report, and tells the end.
pub(crate) fn finish(mut endings: Vec<Ending<impl Serialize>>) -> anyhow::Result<()> {
    // Saved before any is scored: a second Ctrl-C during the scoring loses nothing.
    let ended_secs: Vec<f64> = endings.iter_mut().map(|ending| ending.session.halt()).collect::<anyhow::Result<_>>()?;
    let mut hashes = Vec::new();
    for (Ending { session, out, .. }, seconds) in endings.iter_mut().zip(&ended_secs) {
        hashes.push(session.save(out, *seconds)?);
    }
    if endings.iter().any(|ending| ending.session.stop.asked()) {
        log::info!("saved; scoring the test images, Ctrl-C again leaves that out");
    }
    for ((Ending { session, out, particulars }, seconds), hash) in endings.into_iter().zip(ended_secs).zip(hashes) {
        session.tell_end(&out, seconds, &hash, &particulars)?;
    }
    Ok(())
}

impl Session {
    /// A session around a fresh model; its clock stands still until [`Self::start_clock`].
    pub(crate) fn new(
        gpu: Arc<Gpu>,
        (kind, method): (Kind, Box<dyn Method>),
        evaluators: Evaluators,
        limits: Limits,
        tell: Tell,
    ) -> Self {
        let length = limits.steps.or(limits.seconds.map(whole_secs));
        let template = if length.is_some() { "{bar:30} {elapsed} {msg}" } else { "{spinner} {elapsed} {msg}" };
        Self {
            kind,
            method,
            checkpoints: None,
            decisions: None,
            gpu,
            evaluator: evaluators.at_marks,
            most_at_marks: evaluators.most_at_marks,
            last_evaluator: evaluators.at_end,
            keyframes: Vec::new(),
            tests: VecDeque::new(),
            limits,
            clock: Clock::default(),
            had: Duration::ZERO,
            rested_secs: None,
            marks: Marks::default(),
            told: Vec::new(),
            history: Vec::new(),
            newest_psnr: BTreeMap::new(),
            tell,
            stop: Stop::default(),
            profiles: false,
            bar: print::bar(length, template, matches!(tell, Tell::Json | Tell::Nothing)),
        }
    }

    /// Writes checkpoints, if any, from now on.
    pub(crate) fn with_checkpoints(self, checkpoints: Option<Checkpoints>) -> Self {
        Self { checkpoints, ..self }
    }

    /// Cuts the scoring at a mark short where the end is asked for meanwhile; the mark is not told then.
    pub(crate) fn with_stop(self, stop: &Stop) -> Self {
        Self { stop: stop.clone(), ..self }
    }

    /// Tells at the end what each pass of a step takes, if asked to.
    pub(crate) fn with_profile(self, profiles: bool) -> Self {
        Self { profiles, ..self }
    }

    /// Writes down from now on what depends on the clock.
    pub(crate) fn with_decisions(self, decisions: DecisionLog) -> Self {
        Self { decisions: Some(decisions), ..self }
    }

    /// Goes on where earlier runs had trained for so long; marks they reached are not told again.
    pub(crate) fn going_on_after(mut self, earlier_secs: f64) -> Self {
        self.clock = Clock::after(earlier_secs);
        self.marks.reached(earlier_secs);
        self
    }

    /// Makes it one of several that learn by one clock; it shows no bar, for those would stand in each other's way.
    pub(crate) fn among_others(self, clock: Clock) -> Self {
        Self { clock, bar: ProgressBar::hidden(), ..self }
    }

    /// The scene model's kind.
    pub(crate) fn kind(&self) -> Kind {
        self.kind
    }

    /// Starts the clock, unless it runs.
    pub(crate) fn start_clock(&mut self, at: Instant) {
        self.clock.start(at);
    }

    /// When the clock started, once it runs.
    pub(crate) fn clock_started(&self) -> Option<Instant> {
        self.clock.started()
    }

    /// Keyframes held, in the order they came.
    pub(crate) fn keyframes(&self) -> &[Arc<Keyframe>] {
        &self.keyframes
    }

    /// Seconds of training so far.
    pub(crate) fn secs(&self) -> f64 {
        self.clock.secs()
    }

    /// Gives a keyframe to the model; test keyframes are kept for evaluation too.
    pub(crate) fn push(&mut self, keyframe: &Arc<Keyframe>) -> anyhow::Result<()> {
        if keyframe.split == Split::Test {
            self.tests.push_back(keyframe.clone());
        }
        self.keyframes.push(keyframe.clone());
        self.method.push(keyframe.clone())?;
        if let Some(decisions) = &mut self.decisions {
            decisions.pushed(self.method.n_taken()?, keyframe);
        }
        Ok(())
    }

    /// Takes a keyframe back.
    pub(crate) fn remove(&mut self, camera: &str, stamp: kinematics::Stamp) -> anyhow::Result<()> {
        let is_other = |held: &Arc<Keyframe>| held.camera.as_ref() != camera || held.stamp != stamp;
        self.keyframes.retain(is_other);
        self.tests.retain(is_other);
        self.newest_psnr.retain(|(of, nanos), _| of != camera || *nanos != stamp.0);
        self.method.remove(camera, stamp)?;
        if let Some(decisions) = &mut self.decisions {
            decisions.removed(self.method.n_taken()?, camera, stamp);
        }
        Ok(())
    }

    /// Gives the keyframes so far their splats.
    pub(crate) fn seed(&mut self) -> anyhow::Result<()> {
        self.note_look();
        Ok(self.method.seed()?)
    }

    /// Draws a picture.
    pub(crate) fn render(&mut self, request: &RenderRequest) -> Result<Picture, trainer::Error> {
        self.note_look();
        self.method.render(request)
    }

    /// Waits for what is queued, and says how many updates were made in all, those of trials included.
    pub(crate) fn n_taken(&mut self) -> anyhow::Result<u64> {
        Ok(self.method.n_taken()?)
    }

    /// Whether a limit was reached.
    pub(crate) fn is_over(&self) -> bool {
        self.limits.seconds.is_some_and(|secs| self.secs() >= secs) || self.has_all_steps()
    }

    /// Steps asked for that it has not made; `None` where no number was asked for.
    pub(crate) fn steps_missing(&self) -> Option<u64> {
        Some(self.limits.steps?.saturating_sub(self.method.progress().step))
    }

    /// Whether it made all the steps that were asked for: nothing changes it any more.
    pub(crate) fn has_all_steps(&self) -> bool {
        self.limits.steps.is_some_and(|steps| self.method.progress().step >= steps)
    }

    /// Whether more steps would do nothing until a keyframe comes.
    pub(crate) fn is_idle(&self) -> bool {
        self.method.is_idle()
    }

    /// Trains a slice of at most `n_most` steps, and evaluates when a mark was reached.
    pub(crate) fn step(&mut self, n_most: u64) -> anyhow::Result<u64> {
        let n = self.learn(n_most)?;
        self.tell_due()?;
        Ok(n)
    }

    /// Trains a slice of at most `n_most` steps.
    pub(crate) fn learn(&mut self, n_most: u64) -> anyhow::Result<u64> {
        let left = self.limits.steps.map_or(u64::MAX, |steps| steps.saturating_sub(self.method.progress().step));
        if let Some(decisions) = &mut self.decisions {
            decisions.begun();
        }
        Ok(self.method.step(n_most.min(left))?)
    }

    /// Trains for a turn on a device that others use too, at most `n_most` steps; what was queued is done at its end.
    pub(crate) fn take_turn(&mut self, n_most: impl Fn(&Self) -> u64) -> anyhow::Result<()> {
        let begun = Instant::now();
        let mut n_steps = 0;
        loop {
            let n = self.learn(n_most(self))?;
            n_steps += n;
            let is_at_end = self.is_over() || self.is_idle() || n_most(self) == 0;
            if n == 0 || is_at_end || begun.elapsed() >= TURN {
                break;
            }
        }
        self.method.n_taken()?;
        // Who can do nothing does not take each turn because of that.
        self.had += if n_steps == 0 { TURN } else { begun.elapsed() };
        if self.has_all_steps() {
            self.rest();
        }
        Ok(())
    }

    /// Time it had on a device that it shares.
    pub(crate) fn had(&self) -> Duration {
        self.had
    }

    /// Lets it catch up on no more than what it lacks of this.
    pub(crate) fn had_at_least(&mut self, had: Duration) {
        self.had = self.had.max(had);
    }

    /// Takes it for done, at this time of the clock.
    pub(crate) fn rest(&mut self) {
        let secs = self.secs();
        self.rested_secs.get_or_insert(secs);
    }

    /// Writes the checkpoint that is due, and evaluates when a mark was reached; one that rests has told all.
    pub(crate) fn tell_due(&mut self) -> anyhow::Result<()> {
        if self.rested_secs.is_some() {
            return Ok(());
        }
        let seconds = self.secs();
        if let Some(checkpoints) = &mut self.checkpoints
            && checkpoints.when_due(self.method.as_mut(), seconds)?
            && let Some(decisions) = &mut self.decisions
        {
            decisions.checkpoint(self.method.n_taken()?);
        }
        if self.marks.reached(self.secs()) {
            self.tell_mark()?;
        }
        self.show();
        Ok(())
    }

    /// Evaluates the test keyframe whose score is oldest, for a curve between the marks; counts as training time.
    pub(crate) fn refresh_psnr(&mut self) -> anyhow::Result<()> {
        let Some(oldest) = self.tests.pop_front() else { return Ok(()) };
        self.tests.push_back(oldest.clone());
        self.note_look();
        let quick = Evaluator::psnr_only();
        let scores = quick.score(self.method.as_mut(), &oldest)?;
        self.newest_psnr.insert((scores.camera, scores.stamp_nanos), scores.psnr);
        self.note_psnr();
        Ok(())
    }

    /// Mean over the test keyframes of their newest PSNR, dB.
    pub(crate) fn psnr(&self) -> Option<f64> {
        let n = self.newest_psnr.len();
        (n > 0).then(|| self.newest_psnr.values().sum::<f64>() / n as f64)
    }

    /// The curve of [`Self::psnr`] over seconds.
    pub(crate) fn psnr_history(&self) -> &[(f64, f64)] {
        &self.history
    }

    /// What alignment of the keyframes found, once that is settled.
    pub(crate) fn alignment(&self) -> Option<&Alignment> {
        self.method.alignment()
    }

    /// Where training stands.
    pub(crate) fn progress(&self) -> Progress {
        self.method.progress()
    }

    /// Saves the model after so many seconds of training; its hash comes back.
    fn save(&mut self, out: &Path, seconds: f64) -> anyhow::Result<String> {
        if let Some(decisions) = self.decisions.take()
            && let Err(error) = decisions.end(self.method.n_taken()?)
        {
            log::warn!("{error:#}");
        }
        if self.method.progress().primitives == 0 {
            log::warn!("the model is empty: nothing that was seen could be used");
        }
        run_folder::save_model(self.method.as_mut(), out)?;
        if let Some(checkpoints) = &mut self.checkpoints {
            checkpoints.begin(self.method.as_mut(), seconds)?;
        }
        run_folder::checkpoint_sha256(out)
    }

    /// Scores the saved model a last time, writes the report, and tells the end.
    fn tell_end(
        mut self,
        out: &Path,
        seconds: f64,
        checkpoint_sha256: &str,
        particulars: &impl Serialize,
    ) -> anyhow::Result<()> {
        let outcome = self.score_at_end(seconds)?;
        let done = Done {
            event: "done",
            method: self.kind.name(),
            seconds,
            steps: outcome.steps,
            scores: outcome.scores,
            primitives: outcome.primitives,
            bytes: outcome.bytes,
            out,
            checkpoint_sha256,
        };
        let passes = if self.profiles { self.profile()? } else { Vec::new() };
        let report = Report {
            done: &done,
            adapter: self.gpu.describe(),
            particulars,
            parts: self.method.report(),
            passes,
            marks: &outcome.marks,
            per_image: &outcome.per_image,
        };
        run_folder::write_json(&out.join("report.json"), &report)?;
        let last_checkpoint = self.checkpoints.as_mut().map_or(Ok(()), Checkpoints::wait);
        match self.tell {
            Tell::Json => {
                if self.profiles {
                    let passes = &report.passes;
                    print::json(&Profile { event: "profile", method: self.kind.name(), passes })?;
                }
                print::json(&done)?;
                return last_checkpoint;
            }
            Tell::Bar | Tell::Nothing => return last_checkpoint,
            Tell::Lines => {}
        }
        for (name, millis) in &report.passes {
            print::line(format_args!("{millis:9.3} ms  {name}"))?;
        }
        print::line(format_args!(
            "{seconds:.1} s, {}, {}, {:.1} MB: {}",
            print::counted(done.steps, "step"),
            print::counted(done.primitives, self.method.primitive()),
            done.bytes as f64 / 1e6,
            done.scores
        ))?;
        print::line(format_args!("saved in {}", out.display()))?;
        last_checkpoint
    }

    /// GPU time of each kernel in a step, milliseconds: medians over [`N_PROFILED`] steps, in the order of the first.
    fn profile(&mut self) -> anyhow::Result<Vec<(&'static str, f64)>> {
        let mut names: Vec<&'static str> = Vec::new();
        let mut by_name: BTreeMap<&'static str, Vec<f64>> = BTreeMap::new();
        let began = Instant::now();
        while began.elapsed() < BEFORE_PROFILE {
            self.method.profile_step()?;
        }
        for _ in 0..N_PROFILED {
            let mut sums: BTreeMap<&'static str, f64> = BTreeMap::new();
            for PassTiming { name, millis } in self.method.profile_step()? {
                *sums.entry(name).or_default() += millis;
                if !names.contains(&name) {
                    names.push(name);
                }
            }
            sums.into_iter().for_each(|(name, millis)| by_name.entry(name).or_default().push(millis));
        }
        Ok(names.into_iter().filter_map(|name| Some((name, median(by_name.get(name)?)?))).collect())
    }

    /// Scores the model a last time, and saves nothing.
    pub(crate) fn conclude(mut self) -> anyhow::Result<Outcome> {
        let seconds = self.halt()?;
        self.score_at_end(seconds)
    }

    /// Waits for what is queued; the seconds of training come back.
    fn halt(&mut self) -> anyhow::Result<f64> {
        self.gpu.wait()?;
        let seconds = self.rested_secs.unwrap_or_else(|| self.secs());
        self.bar.finish_and_clear();
        Ok(seconds)
    }

    fn score_at_end(&mut self, seconds: f64) -> anyhow::Result<Outcome> {
        std::mem::swap(&mut self.evaluator, &mut self.last_evaluator);
        let per_image = self.off_the_clock(Self::score_all)?;
        let progress = self.method.progress();
        Ok(Outcome {
            seconds,
            steps: progress.step,
            scores: Scores::mean(&per_image),
            primitives: progress.primitives,
            bytes: progress.bytes,
            marks: std::mem::take(&mut self.told),
            per_image,
        })
    }

    /// Scores all test keyframes.
    fn score_all(&mut self) -> anyhow::Result<Vec<ImageScores>> {
        let tests: Vec<Arc<Keyframe>> = self.tests.iter().cloned().collect();
        self.evaluator.score_all(self.method.as_mut(), tests.iter())
    }

    /// Scores test keyframes spread over all, as many as a mark may; `None` where it was asked to stop meanwhile.
    fn score_some(&mut self) -> anyhow::Result<Option<Vec<ImageScores>>> {
        let before = Instant::now();
        let stride = self.tests.len().div_ceil(self.most_at_marks).max(1);
        let mut tests: Vec<(usize, Arc<Keyframe>)> = self.tests.iter().step_by(stride).cloned().enumerate().collect();
        // However many of them are scored, they are spread evenly.
        tests.sort_by_key(|(ix, _)| ix.reverse_bits());
        let stop = self.stop.clone();
        let goes_on = |n: usize| !stop.asked() && (n == 0 || before.elapsed() < MOST_SCORING_AT_MARKS);
        let wanted = tests.iter().enumerate().take_while(|(n, _)| goes_on(*n)).map(|(_, (_, keyframe))| keyframe);
        let images = self.evaluator.score_all(self.method.as_mut(), wanted)?;
        Ok((!stop.asked()).then_some(images))
    }

    /// Does what is not training: time stands still meanwhile.
    fn off_the_clock<T>(&mut self, work: impl FnOnce(&mut Self) -> anyhow::Result<T>) -> anyhow::Result<T> {
        self.gpu.wait()?;
        self.note_look();
        let before = Instant::now();
        let done = work(self)?;
        self.gpu.wait()?;
        self.clock.exclude(before.elapsed());
        Ok(done)
    }

    fn tell_mark(&mut self) -> anyhow::Result<()> {
        // What was queued up to here belongs to the mark.
        self.gpu.wait()?;
        let seconds = self.secs();
        let Some(images) = self.off_the_clock(Self::score_some)? else { return Ok(()) };
        for image in &images {
            self.newest_psnr.insert((image.camera.clone(), image.stamp_nanos), image.psnr);
        }
        self.note_psnr();
        let progress = self.method.progress();
        let eval = Eval {
            event: "eval",
            method: self.kind.name(),
            seconds,
            step: progress.step,
            scores: Scores::mean(&images),
            n_images: images.len(),
            primitives: progress.primitives,
            bytes: progress.bytes,
            step_millis: (progress.step > 0).then_some(progress.step_millis),
        };
        match self.tell {
            Tell::Json => print::json(&eval)?,
            Tell::Lines => print::line(format_args!(
                "{seconds:7.2} s  step {:6}  {:>15}  {:7.2} ms a step  {}",
                eval.step,
                print::counted(eval.primitives, self.method.primitive()),
                progress.step_millis,
                eval.scores
            ))?,
            Tell::Bar | Tell::Nothing => {}
        }
        self.told.push(eval);
        Ok(())
    }

    /// What is drawn makes splats of keyframes that wait for theirs.
    fn note_look(&mut self) {
        if let Some(decisions) = &mut self.decisions {
            decisions.seeded();
        }
    }

    fn note_psnr(&mut self) {
        let Some(psnr) = self.psnr() else { return };
        self.history.push((self.secs(), psnr));
        if self.history.len() > MAX_HISTORY {
            let mut keep = false;
            self.history.retain(|_| {
                keep = !keep;
                keep
            });
        }
    }

    fn show(&self) {
        let progress = self.method.progress();
        let position = if self.limits.steps.is_some() { progress.step } else { whole_secs(self.secs()) };
        self.bar.set_position(position);
        let psnr = self.psnr().map_or(String::new(), |psnr| format!(", {psnr:.2} dB"));
        let primitives = print::counted(progress.primitives, self.method.primitive());
        self.bar.set_message(format!("step {}, {primitives}{psnr}", progress.step));
    }
}

/// For bars and such.
#[expect(clippy::cast_possible_truncation, reason = "a cast of floats stops at the ends of u64")]
fn whole_secs(secs: f64) -> u64 {
    secs as u64
}
