//! Plays a recording in real time into runs with viewers, with correct and wrong calibration. Each
//! run is measured: the latency of pictures and keyframes, the training speed, and the accuracy
//! over time.

mod measurement;

pub use measurement::{Conditions, HandEyeError, InputCounts, LiveRun};

use crate::findings::BenchResult;
use crate::live_disturbance::LiveDisturbance;
use crate::measured_run::{MeasuredRun, RequestedRun, StartRun};
use crate::over_time::Timeline;
use crate::viewer::ViewerOptions;
use anyhow::{Context, Result, bail};
use capture::{Rig, open};
use measurement::findings;
use messages::InsufficientData;
use session::{DiscardedRun, RunInput};
use std::path::{Path, PathBuf};

/// Options of [`run`].
#[derive(Clone, Debug)]
pub struct LiveOptions {
    /// The recording.
    pub recording: PathBuf,
    /// The rig file. `None` uses the rig file in the recording.
    pub rig: Option<PathBuf>,
    /// Length of each run from the first image, seconds.
    pub seconds: f64,
    /// Whether the recording is played again whenever it ends.
    pub is_repeated: bool,
    /// Numbers of viewers, one run each.
    pub n_viewers: Vec<u64>,
    /// What the viewers request.
    pub viewers: ViewerOptions,
    /// Rotation in degrees and translation in millimeters by which the hand-eye calibration is
    /// wrong in further runs.
    pub hand_eye_error: Option<(f64, f64)>,
    /// Number of directions of the hand-eye error, one run each.
    pub n_directions: u64,
    /// Disturbances, one further run each.
    pub disturbances: Vec<LiveDisturbance>,
    /// Folder for charts and numbers.
    pub out: PathBuf,
    /// Other settings of the runs as text, for the page.
    pub other_settings: Vec<String>,
}

/// Measures all runs, and writes their charts.
///
/// * `start`: starts a run.
/// * `on_run`: receives each run. If it returns an error, the bench ends.
///
/// # Errors
///
/// Fails if the recording or the rig file cannot be read, if a run fails, or if the bench was
/// interrupted before the first run ended.
pub fn run(
    options: &LiveOptions,
    start: StartRun<'_>,
    mut on_run: impl FnMut(&LiveRun) -> Result<()>,
) -> Result<BenchResult> {
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot create {}", options.out.display()))?;
    let rig = options
        .rig
        .as_ref()
        .map(|path| Rig::load(path, &[]))
        .transpose()?;
    let rig = open::recording(&options.recording, rig, &[])?.rig;
    let mut runs = Vec::new();
    let mut data_losses = Vec::new();
    for conditions in options.conditions() {
        let Some((run, losses)) = options.measure(&rig, conditions, start)? else {
            log::warn!("interrupted: the results do not contain the run with {conditions}");
            break;
        };
        // All runs play the same recording, so they have the same losses.
        for loss in losses {
            if !data_losses.contains(&loss) {
                data_losses.push(loss);
            }
        }
        on_run(&run)?;
        runs.push(run);
    }
    // Without a run, no charts are written, because they would only look like a result.
    if runs.is_empty() {
        bail!("interrupted before the first run ended");
    }
    let findings = findings(&options.input(), &runs);
    let page = findings.write(&options.out)?;
    Ok(BenchResult {
        findings,
        page,
        data_losses,
    })
}

impl LiveOptions {
    /// The recording and the pictures, for the page.
    fn input(&self) -> String {
        let [width, height] = self.viewers.size_px;
        let kind = if self.viewers.is_panorama {
            "panoramas"
        } else {
            "pictures"
        };
        let mut input = format!(
            "{}, {kind} of {width}x{height}, {} s",
            self.recording.display(),
            self.seconds
        );
        if self.is_repeated {
            input.push_str(", repeated");
        }
        for setting in &self.other_settings {
            input.push_str(&format!(" {setting}"));
        }
        input
    }

    /// The conditions of each run.
    fn conditions(&self) -> Vec<Conditions> {
        // Runs with errors and disturbances have one viewer each, so that their load is the same.
        let with_one = Conditions {
            n_viewers: 1,
            hand_eye_error: None,
            disturbance: None,
        };
        let right = self.n_viewers.iter().map(|&n_viewers| Conditions {
            n_viewers,
            ..with_one
        });
        // The effect of an error depends on its direction, so several directions are measured.
        let wrong = self
            .hand_eye_error
            .into_iter()
            .flat_map(|(degrees, millimeters)| {
                (1..=self.n_directions).map(move |seed| Conditions {
                    hand_eye_error: Some(HandEyeError {
                        degrees,
                        millimeters,
                        seed,
                    }),
                    ..with_one
                })
            });
        let disturbed = self.disturbances.iter().map(|&disturbance| Conditions {
            disturbance: Some(disturbance),
            ..with_one
        });
        right.chain(wrong).chain(disturbed).collect()
    }

    /// Measures one run, then removes its folder. Returns its measurements and data losses, or
    /// `None` if it was interrupted.
    fn measure(
        &self,
        rig: &Rig,
        conditions: Conditions,
        start: StartRun<'_>,
    ) -> Result<Option<(LiveRun, Vec<String>)>> {
        // The folder is named after the process, so that two benchmarks with the same output do not
        // remove each other's folder.
        let folder = self.out.join(format!("run-{}", std::process::id()));
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
        let measured = self.measure_in(&folder, rig, conditions, start);
        if let Err(error) = std::fs::remove_dir_all(&folder) {
            log::warn!("cannot remove {}: {error}", folder.display());
        }
        measured
    }

    fn measure_in(
        &self,
        folder: &Path,
        rig: &Rig,
        conditions: Conditions,
        start: StartRun<'_>,
    ) -> Result<Option<(LiveRun, Vec<String>)>> {
        let mut rig = rig.clone();
        if let Some(error) = conditions.hand_eye_error {
            error.apply(&mut rig);
        }
        if let Some(disturbance) = conditions.disturbance {
            disturbance.apply_to_rig(&mut rig);
        }
        // The run reads the disturbed rig from a file, as it would read a wrong calibration.
        rig.write_resolved(folder)
            .with_context(|| format!("cannot write into {}", folder.display()))?;
        let started = start(&RequestedRun {
            rig_file: folder.join(drivers::recording::RIG_FILE),
            input: RunInput::Recording {
                path: self.recording.clone(),
                is_real_time: true,
                is_repeated: self.is_repeated,
            },
            seconds: self.seconds,
            out: folder.join("out"),
        })?;
        let (measured, ended) = self.measure_to_end(started, conditions)?;
        let input = InputCounts::of(&ended.input_result);
        match (ended.input_result.input_error, ended.no_model_reason) {
            // An interruption explains all other problems, so it comes first.
            _ if ended.is_interrupted => Ok(None),
            (Some(error), _) => {
                Err(anyhow::Error::new(error).context("the recording cannot be read"))
            }
            (None, Some(reason)) => Err(InsufficientData(reason).into()),
            (None, None) => Ok(Some((LiveRun { input, ..measured }, ended.data_losses))),
        }
    }

    /// Runs until the end, and returns the measurements and the results of the input.
    fn measure_to_end(
        &self,
        mut started: MeasuredRun,
        conditions: Conditions,
    ) -> Result<(LiveRun, DiscardedRun)> {
        // A disturbance in the middle of the run shows how fast the model recovers.
        let change = conditions
            .disturbance
            .and_then(|disturbance| disturbance.keyframe_change(1, 0.5 * self.seconds));
        if let Some(change) = change {
            started.run.live.change_keyframes(change);
        }
        let viewers = started.connect(conditions.n_viewers, self.viewers)?;
        let MeasuredRun {
            mut run,
            page: _page,
        } = started;
        let mut timeline = Timeline::default();
        while run.run_time_slice()? {
            timeline.sample(&run.live, &run.gpu, &viewers);
        }
        // The run is measured before the viewers disconnect, because their latencies are part of
        // the measurement.
        let measured = LiveRun::of(conditions, &run.live, &viewers, &timeline);
        drop(viewers);
        Ok((measured, run.discard()?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Disturbance;

    #[test]
    fn every_viewer_count_direction_and_disturbance_is_one_run() {
        let options = LiveOptions {
            recording: "scan.mcap".into(),
            rig: None,
            seconds: 60.0,
            is_repeated: true,
            n_viewers: vec![0, 4],
            viewers: ViewerOptions {
                size_px: [640, 480],
                is_panorama: true,
                ..ViewerOptions::default()
            },
            hand_eye_error: Some((1.0, 5.0)),
            n_directions: 2,
            disturbances: vec![
                LiveDisturbance {
                    disturbance: Disturbance::PoseNoise,
                    level: 0.5,
                },
                LiveDisturbance {
                    disturbance: Disturbance::Exposure,
                    level: 1.0,
                },
            ],
            out: "bench-live".into(),
            other_settings: vec!["scale 0.5".to_owned()],
        };
        let conditions: Vec<String> = options
            .conditions()
            .iter()
            .map(Conditions::to_string)
            .collect();
        assert_eq!(
            conditions,
            [
                "0 viewers",
                "4 viewers",
                "1 viewer, hand-eye off by 1 degrees, 5 mm (seed 1)",
                "1 viewer, hand-eye off by 1 degrees, 5 mm (seed 2)",
                "1 viewer, pose-noise 0.5 mm",
                "1 viewer, exposure 1 EV"
            ]
        );
        assert_eq!(
            options.input(),
            "scan.mcap, panoramas of 640x480, 60 s, repeated scale 0.5"
        );
    }
}
