//! The measurements of a live run, and their tables and charts.
//!
//! All times are on the clock of this process, from mid-exposure of an image to the arrival of a
//! picture at its viewer.

use crate::findings::Findings;
use crate::live_disturbance::LiveDisturbance;
use crate::over_time::{OverTime, Timeline};
use crate::viewer::{ReceivedPicture, Viewer};
use capture::config::Parent;
use capture::{InputResult, Rig};
use kinematics::Transform;
use messages::counted;
use nalgebra::{UnitQuaternion, UnitVector3, Vector3};
use numbers::random::Random;
use report::Table;
use report::chart::{Axis, Chart, Line, Point, Scale};
use serde::Serialize;
use session::{KeyframeTimes, Latency, LiveLoop};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::time::Duration;

/// Name of the last latency of a keyframe.
const SHOWN: &str = "shutter to shown";

/// An error of the hand-eye calibration.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct HandEyeError {
    /// Rotation, degrees.
    pub degrees: f64,
    /// Translation, millimeters.
    pub millimeters: f64,
    /// Seed of the random directions of rotation and translation.
    pub seed: u64,
}

impl HandEyeError {
    /// Applies the error to all cameras on the flange, for each camera in its own frame.
    pub(super) fn apply(self, rig: &mut Rig) {
        let mut random = Random::new(self.seed);
        let mut direction = || UnitVector3::new_normalize(Vector3::from_fn(|_, _| random.normal()));
        let rotation = UnitQuaternion::from_axis_angle(&direction(), self.degrees.to_radians());
        let translation = direction().into_inner() * self.millimeters * 1e-3;
        let error = Transform::from_parts(translation.into(), rotation);
        for camera in rig
            .cameras
            .iter_mut()
            .filter(|camera| camera.parent == Parent::Flange)
        {
            camera.parent_from_camera *= error;
        }
    }
}

impl fmt::Display for HandEyeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "hand-eye off by {} degrees, {} mm (seed {})",
            self.degrees, self.millimeters, self.seed
        )
    }
}

/// The conditions of one run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Conditions {
    /// Number of viewers that request pictures back to back.
    pub n_viewers: u64,
    /// Error added to the calibration of the recording, if any.
    pub hand_eye_error: Option<HandEyeError>,
    /// Disturbance of the images or poses, if any.
    pub disturbance: Option<LiveDisturbance>,
}

impl fmt::Display for Conditions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&counted(self.n_viewers, "viewer"))?;
        self.hand_eye_error
            .map_or(Ok(()), |error| write!(f, ", {error}"))?;
        self.disturbance
            .map_or(Ok(()), |disturbance| write!(f, ", {disturbance}"))
    }
}

/// The measurements of one run.
#[derive(Clone, Debug, Serialize)]
pub struct LiveRun {
    /// Its conditions.
    pub conditions: Conditions,
    /// Training time, seconds.
    pub seconds: f64,
    /// Number of optimizer steps.
    pub steps: u64,
    /// Steps per second of training time.
    pub steps_per_sec: f64,
    /// Number of primitives of the model at the end, such as splats.
    pub primitives: u64,
    /// Number of keyframes at the end.
    pub keyframes: usize,
    /// Durations by name, in the order in which they occur.
    pub latencies: Vec<(String, Latency)>,
    /// Training seconds and PSNR in dB at the scheduled evaluations.
    pub psnr: Vec<(f64, f64)>,
    /// PSNR of each camera at the last scheduled evaluation, dB. The map is empty with one camera.
    pub psnr_per_camera: BTreeMap<String, f64>,
    /// The run over time.
    pub over_time: OverTime,
    /// Counts of the input.
    pub input: InputCounts,
}

/// Counts of the input of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct InputCounts {
    /// Color images.
    pub images: u64,
    /// Color and depth images that were dropped, by devices or because they arrived too fast.
    pub dropped_images: u64,
    /// Range scans in the world frame.
    pub range_scans: u64,
    /// Registered stations of the base, not counting the first.
    pub stations: usize,
}

impl InputCounts {
    /// Counts of an input that has ended.
    pub(super) fn of(input_result: &InputResult) -> Self {
        let counts = input_result.join.counts();
        Self {
            images: counts.images,
            dropped_images: counts.device_skipped,
            range_scans: counts.range_scans,
            stations: input_result
                .stations
                .as_ref()
                .map_or(0, |stations| stations.reports().len()),
        }
    }
}

impl LiveRun {
    /// Collects the measurements of a run that is over, except for the counts of its input.
    pub(super) fn of(
        conditions: Conditions,
        live: &LiveLoop,
        viewers: &[Viewer],
        timeline: &Timeline,
    ) -> Self {
        // Only the first model is measured, because viewers see this model.
        let session = &live.sessions()[0];
        let progress = session.progress();
        let seconds = session.time().secs();
        let pictures: Vec<Vec<ReceivedPicture>> = viewers.iter().map(Viewer::pictures).collect();
        Self {
            conditions,
            seconds,
            steps: progress.step,
            steps_per_sec: progress.step as f64 / seconds.max(1e-9),
            primitives: progress.primitives,
            keyframes: live.keyframes().len(),
            latencies: latencies(&pictures, live.ledger().keyframes()),
            psnr: session
                .evaluations()
                .iter()
                .filter_map(|evaluation| Some((evaluation.seconds, evaluation.scores.psnr?)))
                .collect(),
            psnr_per_camera: session
                .evaluations()
                .last()
                .map_or(BTreeMap::new(), |evaluation| {
                    evaluation.scores.psnr_per_camera.clone()
                }),
            over_time: timeline.over_time(&pictures),
            input: InputCounts::default(),
        }
    }

    /// The measurements in one line.
    #[must_use]
    pub fn summary(&self) -> String {
        let picture = self.latency("request to complete picture");
        let picture = picture.map_or(String::new(), |latency| {
            format!("  picture {:.1} ms (99 %: {:.1})", latency.p50, latency.p99)
        });
        let psnr = self.psnr.last().map_or(String::new(), |(seconds, psnr)| {
            format!("  {psnr:.2} dB at {seconds:.0} s")
        });
        format!(
            "{}: {:.1} steps per second{picture}{psnr}",
            self.conditions, self.steps_per_sec
        )
    }

    /// A duration by name.
    fn latency(&self, name: &str) -> Option<Latency> {
        self.latencies
            .iter()
            .find(|(known, _)| *known == name)
            .map(|(_, latency)| *latency)
    }
}

/// Latencies of all pictures, and of all keyframes until the first viewer receives them in a
/// picture. If there are several cameras, the list also contains, for each camera, the latency
/// until its keyframes are added to the models.
fn latencies(
    pictures: &[Vec<ReceivedPicture>],
    keyframes: &[KeyframeTimes],
) -> Vec<(String, Latency)> {
    let of_pictures = |name, millis: fn(&ReceivedPicture) -> f64| {
        (name, Latency::of(pictures.iter().flatten().map(millis)))
    };
    let cameras: BTreeSet<&str> = keyframes.iter().map(|keyframe| &*keyframe.camera).collect();
    let to_picture = pictures
        .first()
        .and_then(|pictures| Latency::of(shutter_to_picture(pictures, keyframes)));
    let named = [
        of_pictures("request to complete picture", |picture| {
            millis(picture.complete - picture.requested)
        }),
        of_pictures("request to first stage", |picture| {
            millis(picture.first_stage - picture.requested)
        }),
        of_pictures("picture: waiting", |picture| picture.waited_millis),
        of_pictures("picture: rendering", |picture| picture.render_millis),
        of_pictures("picture: encoding", |picture| picture.encode_millis),
        of_pictures("picture: transfer", |picture| {
            let on_server = picture.waited_millis + picture.render_millis + picture.encode_millis;
            (millis(picture.complete - picture.requested) - on_server).max(0.0)
        }),
    ];
    let named = named
        .into_iter()
        .filter_map(|(name, latency)| Some((name.to_owned(), latency?)));
    // The latencies are in the order in which they occur. A picture is received before it is shown.
    let mut since_shutter = session::latencies(keyframes);
    let shown_at = since_shutter
        .iter()
        .position(|(name, _)| name == SHOWN)
        .unwrap_or(since_shutter.len());
    if let Some(to_picture) = to_picture {
        since_shutter.insert(shown_at, ("shutter to picture".to_owned(), to_picture));
    }
    let of_cameras = cameras
        .iter()
        .filter_map(|camera| camera_latency(camera, keyframes))
        .filter(|_| cameras.len() > 1);
    named.chain(since_shutter).chain(of_cameras).collect()
}

/// Time from mid-exposure until the keyframes of a camera are added to the models, with the name of
/// this latency.
fn camera_latency(camera: &str, keyframes: &[KeyframeTimes]) -> Option<(String, Latency)> {
    let pushed = keyframes
        .iter()
        .filter(|keyframe| *keyframe.camera == *camera)
        .filter_map(|keyframe| keyframe.millis_until(keyframe.pushed));
    Some((
        format!("shutter to model, camera {camera}"),
        Latency::of(pushed)?,
    ))
}

/// For each keyframe, the time from mid-exposure to the arrival of the first picture that contains
/// it, milliseconds.
fn shutter_to_picture<'a>(
    pictures: &'a [ReceivedPicture],
    keyframes: &'a [KeyframeTimes],
) -> impl Iterator<Item = f64> + 'a {
    // The number of keyframes in a picture never falls, so the search for the next keyframe
    // continues where the previous search ended.
    let mut rest = pictures;
    (1..).zip(keyframes).filter_map(move |(n, keyframe)| {
        let first = rest.iter().position(|picture| picture.n_keyframes >= n)?;
        rest = &rest[first..];
        keyframe.millis_until(rest[0].complete)
    })
}

fn millis(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

/// A row of a table, with the name of a quantity and its value in each run.
fn row(name: &str, runs: &[LiveRun], value: &dyn Fn(&LiveRun) -> String) -> Vec<String> {
    std::iter::once(name.to_owned())
        .chain(runs.iter().map(value))
        .collect()
}

/// The rows of all quantities that at least one run has.
fn rows(runs: &[LiveRun]) -> Vec<Vec<String>> {
    let mut rows: Vec<Vec<String>> = Vec::new();
    let mut add =
        |name: &str, value: &dyn Fn(&LiveRun) -> String| rows.push(row(name, runs, value));
    // Runs without viewers have no latencies of pictures, so the names of all runs are collected.
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in runs.iter().flat_map(|run| &run.latencies) {
        if !names.contains(&&**name) {
            names.push(name);
        }
    }
    for name in names {
        add(&format!("{name}, ms"), &|run| {
            run.latency(name).map_or(String::new(), |latency| {
                format!("{:.1} / {:.1}", latency.p50, latency.p99)
            })
        });
    }
    add("training steps per second", &|run| {
        format!("{:.1}", run.steps_per_sec)
    });
    add("primitives", &|run| run.primitives.to_string());
    add("keyframes", &|run| run.keyframes.to_string());
    let is_any = |count: fn(&InputCounts) -> bool| runs.iter().any(|run| count(&run.input));
    if is_any(|input| input.dropped_images > 0) {
        add("images dropped", &|run| {
            run.input.dropped_images.to_string()
        });
    }
    if is_any(|input| input.range_scans > 0) {
        add("range scans", &|run| run.input.range_scans.to_string());
    }
    if is_any(|input| input.stations > 0) {
        add("stations registered", &|run| run.input.stations.to_string());
    }
    // Every run has the same schedule, but some runs may have ended earlier.
    let marks = runs
        .iter()
        .map(|run| &run.psnr)
        .max_by_key(|psnr| psnr.len());
    for (ix, (seconds, _)) in marks.into_iter().flatten().enumerate() {
        add(&format!("test PSNR at {seconds:.1} s, dB"), &|run| {
            run.psnr
                .get(ix)
                .map_or(String::new(), |(_, psnr)| format!("{psnr:.2}"))
        });
    }
    let cameras: BTreeSet<&String> = runs
        .iter()
        .flat_map(|run| run.psnr_per_camera.keys())
        .collect();
    for camera in cameras {
        add(&format!("last test PSNR, camera {camera}, dB"), &|run| {
            run.psnr_per_camera
                .get(camera)
                .map_or(String::new(), |psnr| format!("{psnr:.2}"))
        });
    }
    rows
}

impl LiveRun {
    /// PSNR over time.
    fn line(&self) -> Line {
        let point = |(x, y): (f64, f64)| Point {
            x,
            y,
            low: y,
            high: y,
        };
        Line {
            label: self.conditions.to_string(),
            points: self.psnr.iter().copied().map(point).collect(),
            is_peer: false,
        }
    }
}

/// PSNR over time of all runs.
fn accuracy_chart(input: &str, runs: &[LiveRun]) -> Chart {
    Chart {
        title: "Accuracy of a live run".to_owned(),
        subtitle: input.to_owned(),
        x: Axis {
            label: "seconds of training".to_owned(),
            scale: Scale::Log,
            ticks: Vec::new(),
        },
        y: Axis {
            label: "test PSNR, dB".to_owned(),
            scale: Scale::Linear,
            ticks: Vec::new(),
        },
        lines: runs
            .iter()
            .map(LiveRun::line)
            .filter(|line| !line.points.is_empty())
            .collect(),
        thresholds: Vec::new(),
        markers: Vec::new(),
    }
}

/// All quantities of a run over time.
fn over_time_chart(input: &str, run: &LiveRun) -> Chart {
    Chart {
        title: "Live run over time".to_owned(),
        subtitle: format!("{}: {input}", run.conditions),
        x: Axis {
            label: "minutes of training".to_owned(),
            scale: Scale::Linear,
            ticks: Vec::new(),
        },
        y: Axis {
            label: "% of the median in the second half".to_owned(),
            scale: Scale::Linear,
            ticks: Vec::new(),
        },
        lines: run.over_time.lines(),
        thresholds: Vec::new(),
        markers: Vec::new(),
    }
}

/// A table and a chart of runs on the same recording.
///
/// * `input`: the recording and the pictures, for the page.
pub(super) fn findings(input: &str, runs: &[LiveRun]) -> Findings {
    let head: Vec<String> = std::iter::once("quantity".to_owned())
        .chain(runs.iter().map(|run| run.conditions.to_string()))
        .collect();
    let mut tables = vec![Table {
        title: "Live run (durations: median / 99th percentile)".to_owned(),
        head: head.clone(),
        rows: rows(runs),
    }];
    let trends = OverTime::rows(&runs.iter().map(|run| &run.over_time).collect::<Vec<_>>());
    if !trends.is_empty() {
        tables.push(Table {
            title: "Second half of the run: median and change per hour".to_owned(),
            head,
            rows: trends,
        });
    }
    let mut charts = vec![("", accuracy_chart(input, runs))];
    // The chart shows the first run with viewers, because a run without viewers has no latency. The
    // order is reversed because `max_by_key` returns the last of several equal runs.
    let charted = runs
        .iter()
        .rev()
        .max_by_key(|run| run.over_time.trends.len());
    if let Some(run) = charted.filter(|run| !run.over_time.trends.is_empty()) {
        charts.push(("-over-time", over_time_chart(input, run)));
    }
    Findings {
        name: "live",
        title: "Live run".to_owned(),
        sentences: vec![
            format!("{input}. Durations are medians / 99th percentiles."),
            "A picture contains a keyframe if the model took a step after the keyframe was added. Shutter times are mid-exposure."
                .to_owned(),
        ],
        charts,
        tables,
        numbers: serde_json::json!({ "input": input, "runs": runs }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use capture::InputTimes;
    use kinematics::Stamp;
    use std::time::Instant;

    fn at(began: Instant, after_millis: u64) -> Instant {
        began + Duration::from_millis(after_millis)
    }

    fn keyframe(began: Instant, captured_millis: u64) -> KeyframeTimes {
        let captured = at(began, captured_millis);
        KeyframeTimes {
            camera: "wrist".into(),
            stamp: Stamp(0),
            input: InputTimes {
                captured: Some(captured),
                arrived: at(captured, 5),
                queued: at(captured, 8),
            },
            pushed: at(captured, 12),
            pushed_at_steps: vec![0],
            trained: Some(at(captured, 20)),
            sent: Some(at(captured, 24)),
            shown: Some(at(captured, 33)),
        }
    }

    fn picture(
        began: Instant,
        requested_millis: u64,
        complete_millis: u64,
        n_keyframes: u64,
    ) -> ReceivedPicture {
        ReceivedPicture {
            requested: at(began, requested_millis),
            first_stage: at(began, requested_millis + 1),
            complete: at(began, complete_millis),
            waited_millis: 1.0,
            render_millis: 2.0,
            encode_millis: 3.0,
            n_keyframes,
        }
    }

    #[test]
    fn latency_ends_at_the_first_picture_with_the_keyframe() {
        let began = Instant::now();
        let keyframes = [
            keyframe(began, 0),
            keyframe(began, 10),
            keyframe(began, 100),
            keyframe(began, 200),
        ];
        let pictures = [
            picture(began, 0, 20, 0),
            picture(began, 20, 50, 2),
            picture(began, 50, 130, 3),
        ];
        let seen: Vec<f64> = shutter_to_picture(&pictures, &keyframes).collect();
        assert_eq!(
            seen.iter().map(|millis| millis.round()).collect::<Vec<_>>(),
            [50.0, 40.0, 30.0]
        );
        let latencies = latencies(&[pictures.to_vec()], &keyframes);
        let p50 = |name: &str| {
            latencies
                .iter()
                .find(|(known, _)| *known == name)
                .expect("measured")
                .1
                .p50
                .round()
        };
        assert_eq!(p50("request to complete picture"), 30.0);
        assert_eq!(p50("picture: transfer"), 24.0);
        assert_eq!(
            [
                "shutter to arrival",
                "shutter to model",
                "shutter to first step"
            ]
            .map(p50),
            [5.0, 12.0, 20.0]
        );
        let names: Vec<&str> = latencies.iter().map(|(name, _)| &**name).collect();
        assert_eq!(
            names[names.len() - 3..],
            ["shutter to sent", "shutter to picture", "shutter to shown"]
        );
        assert_eq!(["shutter to sent", SHOWN].map(p50), [24.0, 33.0]);
    }

    #[test]
    fn hand_eye_error_has_the_requested_size() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
        let rig = Rig::load(&path, &[]).expect("a bundled rig file");
        let mut wrong = rig.clone();
        HandEyeError {
            degrees: 1.0,
            millimeters: 5.0,
            seed: 3,
        }
        .apply(&mut wrong);
        let error =
            rig.cameras[0].parent_from_camera.inverse() * wrong.cameras[0].parent_from_camera;
        assert!((error.rotation.angle().to_degrees() - 1.0).abs() < 1e-9);
        assert!((error.translation.vector.norm() - 5e-3).abs() < 1e-12);
        let mut other = rig.clone();
        HandEyeError {
            degrees: 1.0,
            millimeters: 5.0,
            seed: 4,
        }
        .apply(&mut other);
        assert_ne!(other, wrong);
    }
}
