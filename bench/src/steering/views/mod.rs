//! How fast the model learns views that the scan never had, when an operator steers the camera
//! there.
//!
//! A run with a simulated arm is started in another process. Its commands and pictures take the way
//! of a page: `/steer` and `/ws`. After a short scan, the operator takes the arm, and steers its
//! camera to random views that are far from all keyframes. The photograph of the first keyframe
//! there shows how good the picture of the model was before, and how good it is afterward.

mod page_client;
mod run_process;

use super::client::SteeringClient;
use super::link::LinkFault;
use super::operator::SAMPLE_PERIOD;
use anyhow::{Context, Result, bail};
use capture::config::Rig;
use image::RgbImage;
use kinematics::{Transform, transform};
use nalgebra::{UnitQuaternion, Vector3};
use numbers::random::Random;
use page_client::{Lens, ListedKeyframe, PageClient};
use report::Table;
use run_process::RunProcess;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// Command of the run, see [`Processes::run`](super::Processes::run).
type RunCommand = fn(rig: &Path, out: &Path) -> Result<Command>;

/// Number of keyframes of the scan. A longer scan would leave no view that it never had.
const N_SCANNED: u64 = 12;
/// Maximum time until the scan has them, on a computer without a GPU.
const MAX_SCAN: Duration = Duration::from_secs(600);
/// A view is new if it is at least this far from all keyframes, or turned by this angle. The
/// scene is then seen from another side, or another part of it.
const NEW_M: f64 = 0.15;
const NEW_RAD: f64 = 0.4;
/// Largest distance of a view from the tip before, meters and radians.
const MAX_MOVE_M: f64 = 0.3;
const MAX_TURN_RAD: f64 = 0.8;
/// Number of random views of which one must be new and within reach.
const MAX_TRIES: u32 = 400;
/// A keyframe shows the view if it is this close to it.
const NEAR_M: f64 = 0.02;
const NEAR_RAD: f64 = 0.05;
/// Distance at which the tip has arrived, meters.
const ARRIVED_M: f64 = 0.005;
/// Maximum time until the arm is there.
const MAX_WAY: Duration = Duration::from_secs(60);
/// Time since the start of the motion at which the picture must be better by [`GOAL_DB`].
const GOAL_TIME: Duration = Duration::from_secs(20);
const GOAL_DB: f64 = 5.0;
/// Time between two pictures.
const LOOK_PERIOD: Duration = Duration::from_millis(500);
/// Number of samples with an open switch before a grip.
const N_OPEN_SAMPLES: u32 = 5;

/// The run, and the views to which an operator steers its camera.
#[derive(Clone, Debug)]
pub struct ViewOptions {
    /// The rig file, which is simulated.
    pub rig: PathBuf,
    /// Number of views.
    pub n_views: u32,
    /// Round trip between the operator and the run, in addition to that of this computer.
    pub round_trip: Duration,
}

/// What happened at one view.
#[derive(Clone, Debug, Serialize)]
pub struct ViewRow {
    /// Added round trip, milliseconds.
    pub round_trip_millis: f64,
    /// Whether the goal was previewed before the arm moved, because of the round trip.
    pub is_previewed: bool,
    /// Distance of the view from the closest keyframe, meters.
    pub from_keyframes_m: f64,
    /// Time from the grip until the arm was there, seconds; `None` if it did not arrive.
    pub arrived_secs: Option<f64>,
    /// PSNR of the picture there before the motion, dB.
    pub before_db: Option<f64>,
    /// PSNR 20 seconds after the grip, dB.
    pub after_db: Option<f64>,
    /// Time from the grip until the PSNR was higher by 5 dB, seconds.
    pub better_secs: Option<f64>,
    /// Why the arm did not arrive, if it did not.
    pub reason: Option<String>,
}

/// Steers to views.
///
/// * `program`: this program, which starts the run.
/// * `out`: folder of the run.
///
/// # Errors
///
/// If the run cannot be started or steered.
pub(super) fn measure(
    options: &ViewOptions,
    command: RunCommand,
    out: &Path,
) -> Result<Vec<ViewRow>> {
    let rig = Rig::load(&options.rig, &[]).context("the rig file of the views")?;
    let mut steered = SteeredViews::start(options, &rig, command, out)?;
    let mut rows = Vec::new();
    for view in 0..options.n_views {
        let row = steered.try_view()?;
        log::info!("view {}: {row:?}", view + 1);
        rows.push(row);
    }
    Ok(rows)
}

/// A run that is steered.
struct SteeredViews {
    _run: RunProcess,
    page: PageClient,
    client: SteeringClient,
    round_trip: Duration,
    /// Greatest round trip at which the arm follows without a preview.
    servo_round_trip: Duration,
    world_from_base: Transform,
    tip_from_camera: Transform,
    random: Random,
    grip: u64,
    n_previews: u64,
}

/// A view that no keyframe has.
struct NewView {
    base_from_tip: Transform,
    world_from_camera: Transform,
    from_keyframes_m: f64,
}

impl SteeredViews {
    fn start(options: &ViewOptions, rig: &Rig, command: RunCommand, out: &Path) -> Result<Self> {
        let run = RunProcess::start(command(&options.rig, out)?)?;
        let page = PageClient::connect(run.server())?;
        page.wait_for_keyframes(N_SCANNED, MAX_SCAN)?;
        let client = SteeringClient::connect(run.server(), 1)?;
        // The clock is synchronized before, as by a page that has been open for a while.
        client.set_link(LinkFault {
            delay: options.round_trip / 2,
            ..LinkFault::default()
        });
        client.lease("take")?;
        let number = client.number();
        client.wait_for_state("control", |state| state.holder == Some(number))?;
        let camera = rig.cameras.first().context("the rig has no camera")?;
        Ok(Self {
            _run: run,
            page,
            servo_round_trip: client.servo_round_trip(),
            client,
            round_trip: options.round_trip,
            world_from_base: rig.base.world_from_base,
            tip_from_camera: camera.parent_from_camera,
            random: Random::new(1),
            grip: 0,
            n_previews: 0,
        })
    }

    fn try_view(&mut self) -> Result<ViewRow> {
        self.wait_for_rest()?;
        let keyframes = self.page.keyframes();
        let lens = keyframes.first().context("the run has no keyframe")?.lens;
        let view = self.choose(&keyframes)?;
        let before = self.page.picture(&view.world_from_camera, &lens)?;
        let mut row = ViewRow {
            round_trip_millis: 1e3 * self.round_trip.as_secs_f64(),
            is_previewed: self.round_trip > self.servo_round_trip,
            from_keyframes_m: view.from_keyframes_m,
            arrived_secs: None,
            before_db: None,
            after_db: None,
            better_secs: None,
            reason: None,
        };
        let began = Instant::now();
        if let Err(reason) = self.steer_to(&view)? {
            row.reason = Some(reason);
            return Ok(row);
        }
        row.arrived_secs = Some(began.elapsed().as_secs_f64());
        self.watch(&view, (&before, &lens), began, &mut row)?;
        Ok(row)
    }

    /// Looks at the picture there until the time is over.
    fn watch(
        &mut self,
        view: &NewView,
        (before, lens): (&RgbImage, &Lens),
        began: Instant,
        row: &mut ViewRow,
    ) -> Result<()> {
        let mut photograph: Option<(ListedKeyframe, RgbImage)> = None;
        while began.elapsed() < GOAL_TIME || photograph.is_none() {
            if began.elapsed() > MAX_WAY + GOAL_TIME {
                row.reason = Some("the run took no keyframe there".to_owned());
                return Ok(());
            }
            std::thread::sleep(LOOK_PERIOD);
            self.client.lease("renew")?;
            let Some((keyframe, shown)) = &photograph else {
                photograph = self.photograph_near(&view.world_from_camera)?;
                row.before_db = photograph.as_ref().map(|(_, shown)| psnr_db(before, shown));
                continue;
            };
            let picture = self.page.picture(&keyframe.world_from_camera, lens)?;
            let db = psnr_db(&picture, shown);
            row.after_db = Some(db);
            let is_better = row.before_db.is_some_and(|before| db >= before + GOAL_DB);
            if is_better && row.better_secs.is_none() {
                row.better_secs = Some(began.elapsed().as_secs_f64());
            }
        }
        Ok(())
    }

    /// The newest keyframe at a view, with its photograph.
    fn photograph_near(
        &mut self,
        world_from_camera: &Transform,
    ) -> Result<Option<(ListedKeyframe, RgbImage)>> {
        let is_near = |keyframe: &ListedKeyframe| {
            let gap = gap(&keyframe.world_from_camera, world_from_camera);
            gap.0 <= NEAR_M && gap.1 <= NEAR_RAD
        };
        let Some(keyframe) = self.page.keyframes().into_iter().rfind(is_near) else {
            return Ok(None);
        };
        let shown = self.page.photograph(keyframe.id)?;
        Ok(Some((keyframe, shown)))
    }

    /// A random view that no keyframe has, and that the run says is within reach.
    fn choose(&mut self, keyframes: &[ListedKeyframe]) -> Result<NewView> {
        let state = self.client.raw_state().context("the run sent no state")?;
        let base_from_tip = pose(&state["base_from_tip"]).context("the run sent no pose")?;
        for _ in 0..MAX_TRIES {
            let mut axis = |most: f64| {
                Vector3::from_fn(|_, _| self.random.uniform(-1.0, 1.0)).cap_magnitude(1.0) * most
            };
            let moved = Transform::from_parts(
                (base_from_tip.translation.vector + axis(MAX_MOVE_M)).into(),
                base_from_tip.rotation * UnitQuaternion::from_scaled_axis(axis(MAX_TURN_RAD)),
            );
            let world_from_camera = self.world_from_base * moved * self.tip_from_camera;
            let gaps = keyframes
                .iter()
                .map(|keyframe| gap(&keyframe.world_from_camera, &world_from_camera));
            let is_new = gaps.clone().all(|(m, rad)| m >= NEW_M || rad >= NEW_RAD);
            if !is_new || !self.is_reachable(&moved)? {
                continue;
            }
            return Ok(NewView {
                base_from_tip: moved,
                world_from_camera,
                from_keyframes_m: gaps.map(|gap| gap.0).fold(f64::INFINITY, f64::min),
            });
        }
        bail!("no new view is within reach of the arm")
    }

    /// Whether the page would show a goal as reachable.
    fn is_reachable(&mut self, base_from_tip: &Transform) -> Result<bool> {
        self.n_previews += 1;
        let id = self.n_previews;
        self.client.send(&json!({
            "type": "preview",
            "id": id,
            "base_from_tip": transform::to_xyz_xyzw(base_from_tip),
        }))?;
        let preview = self.client.wait_for_preview(id)?;
        Ok(preview["verdict"] == "reachable")
    }

    /// Holds the switch until the arm is there. Returns why it did not arrive.
    fn steer_to(&mut self, view: &NewView) -> Result<Result<(), String>> {
        for _ in 0..N_OPEN_SAMPLES {
            let open = self.client.command(None, &Value::Null);
            self.client.send(&open)?;
            std::thread::sleep(SAMPLE_PERIOD);
        }
        self.grip += 1;
        self.client.forget();
        let intent = json!({
            "kind": "pose",
            "base_from_tip": transform::to_xyz_xyzw(&view.base_from_tip),
        });
        let until = Instant::now() + MAX_WAY;
        let mut reason = Some("it did not arrive in time".to_owned());
        while Instant::now() < until {
            let sample = self.client.command(Some(self.grip), &intent);
            self.client.send(&sample)?;
            std::thread::sleep(SAMPLE_PERIOD);
            let state = self.client.raw_state().context("the run sent no state")?;
            let tip = pose(&state["base_from_tip"]).context("the run sent no pose")?;
            let left_m = gap(&tip, &view.base_from_tip).0;
            if left_m <= ARRIVED_M && state["is_moving"] == false {
                reason = None;
                break;
            }
            if let Some(refusal) = self.client.refusals().first() {
                reason = Some(refusal.clone());
                break;
            }
            if state["is_moving"] == false {
                reason = state["limits"][0]["text"]
                    .as_str()
                    .map(str::to_owned)
                    .or(reason);
            }
        }
        let open = self.client.command(None, &Value::Null);
        self.client.send(&open)?;
        Ok(reason.map_or(Ok(()), Err))
    }

    fn wait_for_rest(&self) -> Result<()> {
        let until = Instant::now() + MAX_WAY;
        loop {
            let state = self.client.raw_state();
            if state.is_some_and(|state| state["is_moving"] == false) {
                return Ok(());
            }
            if Instant::now() > until {
                bail!("the arm is not at rest within {} s", MAX_WAY.as_secs());
            }
            self.client.lease("renew")?;
            std::thread::sleep(LOOK_PERIOD);
        }
    }
}

/// Distance and angle between two poses.
fn gap(a: &Transform, b: &Transform) -> (f64, f64) {
    let distance_m = (a.translation.vector - b.translation.vector).norm();
    (distance_m, a.rotation.angle_to(&b.rotation))
}

/// A pose of seven numbers.
fn pose(numbers: &Value) -> Option<Transform> {
    let mut pose = [0.0; 7];
    for (ix, number) in pose.iter_mut().enumerate() {
        *number = numbers[ix].as_f64()?;
    }
    Some(transform::from_xyz_xyzw(pose))
}

/// Peak signal-to-noise ratio of two images, dB. The first one is resized if necessary.
fn psnr_db(picture: &RgbImage, photograph: &RgbImage) -> f64 {
    let (width, height) = photograph.dimensions();
    let resized;
    let picture = if picture.dimensions() == (width, height) {
        picture
    } else {
        resized = image::imageops::resize(
            picture,
            width,
            height,
            image::imageops::FilterType::Triangle,
        );
        &resized
    };
    let squares = picture.iter().zip(photograph.iter());
    let sum: f64 = squares
        .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2))
        .sum();
    let mean = sum / f64::from(width * height * 3);
    10.0 * (255.0 * 255.0 / mean.max(1e-6)).log10()
}

/// The table of all views.
pub(super) fn table(rows: &[ViewRow]) -> Table {
    let head = [
        "round trip, ms",
        "preview first",
        "from the closest keyframe, m",
        "arrived, s",
        "PSNR before, dB",
        "after 20 s",
        "5 dB better, s",
        "why not",
    ];
    let number = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |v| format!("{v:.1}"));
    let cells = |row: &ViewRow| {
        vec![
            format!("{:.0}", row.round_trip_millis),
            if row.is_previewed { "yes" } else { "no" }.to_owned(),
            format!("{:.2}", row.from_keyframes_m),
            number(row.arrived_secs),
            number(row.before_db),
            number(row.after_db),
            number(row.better_secs),
            row.reason.clone().unwrap_or_default(),
        ]
    };
    Table {
        title: "Views that the scan never had".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows: rows.iter().map(cells).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn psnr_is_that_of_the_mean_square_and_falls_with_the_error() {
        let image = |value: u8| RgbImage::from_pixel(8, 4, image::Rgb([value; 3]));
        let db = psnr_db(&image(100), &image(110));
        assert!((db - 10.0 * (255.0_f64 * 255.0 / 100.0).log10()).abs() < 1e-9);
        assert!(psnr_db(&image(100), &image(120)) < db);
        let small = RgbImage::from_pixel(4, 2, image::Rgb([110; 3]));
        assert!(psnr_db(&small, &image(110)) > 80.0);
    }
}
