//! Corrects the pose of a moving base at each station by registering its images there with those of
//! earlier stations.
//!
//! Keyframes pass through this module on their way from the join to the trainer. Keyframes of the
//! first station pass unchanged. Later, keyframes are queued while the base moves. The first
//! keyframes of the next station are queued as well, until this station can be registered with
//! earlier stations ([`calibration::register_station`]). Then these keyframes and all later ones
//! pass with the correction. The result depends only on the keyframes and their order, so that a
//! run, its recording and the replay of that recording agree. Only the time at which keyframes pass
//! depends on a clock.

use crate::config::{BaseDriver, Parent, Rig};
use crate::join::Change;
use crate::pose_distance::PoseDistance;
use background::{Task, run_in_background_pool};
use calibration::{MIN_VALIDATION_IMAGES, StationCorrection, register_station};
use keyframe::{BaseState, Keyframe, Split};
use kinematics::{Stamp, Transform};
use messages::counted;
use serde::Serialize;
use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Number of keyframes with which a station is registered. Only keyframes with depth that are not
/// test keyframes count. A scan of a few seconds gives this many keyframes. With a larger number,
/// keyframes reach the trainer later. With a smaller number, the correction has fewer pairs of
/// images and is less certain.
const MIN_KEYFRAMES: usize = 14;
/// Maximum time to wait for [`MIN_KEYFRAMES`] keyframes and [`MIN_VALIDATION_IMAGES`], seconds.
/// Without a limit, a short visit or a camera without texture in view would hold its keyframes until
/// the base leaves.
const MAX_SCAN_SECS: f64 = 10.0;
/// Maximum time to wait for a station while the base moves, seconds. A base that drives for longer
/// may not stop at all. After this time, or if [`MAX_HELD`] keyframes are queued, the queued
/// keyframes get the correction of the previous station.
const MAX_TRAVEL_SECS: f64 = 30.0;
const MAX_HELD: usize = 128;
/// Maximum number of reference keyframes from earlier stations. It bounds memory and the time of a
/// registration, which compares new keyframes with the reference keyframes. When the maximum is
/// reached, every second reference keyframe is removed. The remaining keyframes still cover all
/// stations.
const MAX_REFERENCE_KEYFRAMES: usize = 160;

/// Corrects keyframes for errors of the reported base poses, at each station.
///
/// A station is an interval in which the base is stationary. The keyframes of a station are
/// registered with those of earlier stations. Keyframes that were taken on the way between two
/// stations get a share of the correction.
pub struct Stations {
    /// Cameras on the base or the arm.
    carried: BTreeSet<Arc<str>>,
    max_wait_secs: f64,
    /// The station of the last keyframe that passed; `None` before the first.
    station: Option<usize>,
    /// The reported base pose at that station.
    world_from_base: Transform,
    /// The correction of base poses since that station.
    map_from_odom: Transform,
    /// Corrected keyframes with depth from all stations so far.
    reference_keyframes: Vec<Arc<Keyframe>>,
    /// Queued keyframes on the way to the next station and at it, in order.
    held: Vec<Change>,
    /// Changes received since registration of the next station started.
    queue: VecDeque<Change>,
    search: Option<Task<SearchResult>>,
    reported: Vec<StationReport>,
    /// Total time spent on registration.
    spent: Duration,
}

/// Change of the base correction from the station that the base left to the new one.
struct CorrectionChange<'a> {
    /// Reported base pose at the station that the base left.
    left: Transform,
    /// Reported base pose at the new station.
    arrived: Transform,
    /// The correction before the new station.
    before: Transform,
    /// The additional correction that registration estimated. `None` if the images do not overlap
    /// with those of earlier stations.
    estimated: Option<&'a StationCorrection>,
}

impl CorrectionChange<'_> {
    /// The correction of a base state.
    ///
    /// Drift accumulates with the distance traveled. On the way between the two stations, a
    /// keyframe therefore gets a share of the correction in proportion to that distance.
    fn of(&self, at: &BaseState) -> Transform {
        if at.station.is_some() {
            return self.at(&self.arrived, 1.0);
        }
        let from = distance(&self.left, &at.world_from_base);
        let to = distance(&at.world_from_base, &self.arrived);
        // If the base has not moved yet, it has not drifted. The condition also avoids 0 / 0.
        let fraction = if from > 0.0 { from / (from + to) } else { 0.0 };
        self.at(&at.world_from_base, fraction)
    }

    /// The correction at a reported base pose that lies at this fraction of the path.
    fn at(&self, reported: &Transform, fraction: f64) -> Transform {
        let guess = self.before * reported;
        self.estimated.map_or(self.before, |correction| {
            correction.map_from_odom(&guess, fraction) * self.before
        })
    }
}

/// Result of registering a station.
struct SearchResult {
    correction: Option<StationCorrection>,
    took: Duration,
}

/// Report on a station after the first. It is serialized in run reports and printed as one line.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StationReport {
    /// Index of the station, counted from 0.
    station: usize,
    /// Number of keyframes used for registration.
    n_keyframes: usize,
    /// The correction since the previous station; null if the images do not overlap with those of
    /// earlier stations.
    correction: Option<StationCorrection>,
    /// Error of the base pose before and after the correction. It is known only in simulation.
    #[serde(skip_serializing_if = "Option::is_none")]
    base_error: Option<[PoseDistance; 2]>,
}

impl Stations {
    /// Corrections for the base of a rig. `None` if the base does not move, if
    /// [`Base::realign`](crate::config::Base::realign) is not set, or if the rig has a range
    /// scanner, because its scans correct the base all the time ([`Join::drift`](crate::Join)).
    #[must_use]
    pub fn new(rig: &Rig) -> Option<Self> {
        let is_corrected_by_scans = !rig.scanners.is_empty();
        if rig.base.driver == BaseDriver::Fixed || !rig.base.realign || is_corrected_by_scans {
            return None;
        }
        let on_base = rig
            .cameras
            .iter()
            .filter(|camera| camera.parent != Parent::World);
        Some(Self {
            carried: on_base.map(|camera| Arc::clone(&camera.name)).collect(),
            max_wait_secs: rig.join.max_wait_millis * 1e-3,
            station: None,
            world_from_base: Transform::identity(),
            map_from_odom: Transform::identity(),
            reference_keyframes: Vec::new(),
            held: Vec::new(),
            queue: VecDeque::new(),
            search: None,
            reported: Vec::new(),
            spent: Duration::ZERO,
        })
    }

    /// Continues after the keyframes of an earlier run. The first station is registered with these
    /// keyframes.
    #[must_use]
    pub fn resume_from(mut self, keyframes: &[Arc<Keyframe>]) -> Self {
        /// Station index of the earlier run, different from all stations of this run.
        const PREVIOUS_RUN: usize = usize::MAX;
        // The last keyframe has the correction with which the earlier run ended. This correction is
        // the best guess for the first station, because odometry often continues between runs.
        if let Some(base_state) = keyframes
            .iter()
            .rev()
            .find_map(|keyframe| keyframe.base.as_ref())
        {
            self.station = Some(PREVIOUS_RUN);
            self.world_from_base = base_state.world_from_base;
            self.map_from_odom = base_state.map_from_odom;
        }
        keyframes
            .iter()
            .for_each(|keyframe| self.add_reference(keyframe));
        self
    }

    /// Processes a change. Returns the changes that can be passed on, in order.
    pub(crate) fn push(&mut self, change: Change) -> Vec<Change> {
        self.queue.push_back(change);
        let mut released = Vec::new();
        self.process_queue(false, &mut released);
        released
    }

    /// Updates the time, because the wait for a station is limited. `newest`: the newest stamp of
    /// all samples, on the clock of the keyframes. Returns the changes that can be passed on, in
    /// order.
    pub(crate) fn advance_to(&mut self, newest: Stamp) -> Vec<Change> {
        let mut released = Vec::new();
        self.process_queue(false, &mut released);
        // Images with earlier stamps have already been decided by the join.
        let settled_until = newest.plus_secs(-self.max_wait_secs);
        if self.search.is_none() && self.is_overdue(settled_until) {
            self.start_search(&mut released);
        }
        released
    }

    /// Processes all queued changes at the end of the input. Returns them in order.
    pub(crate) fn finish(&mut self) -> Vec<Change> {
        let mut released = Vec::new();
        self.process_queue(true, &mut released);
        // Each pass registers the station whose keyframes are at the front. Keyframes of further
        // stations may queue behind them.
        while !self.held.is_empty() {
            self.start_search(&mut released);
            self.process_queue(true, &mut released);
        }
        released
    }

    /// Restarts at an uncorrected first station, because the source has restarted. Returns the
    /// queued changes in order.
    pub(crate) fn restart(&mut self) -> Vec<Change> {
        let released = self.finish();
        self.station = None;
        self.world_from_base = Transform::identity();
        self.map_from_odom = Transform::identity();
        released
    }

    /// Corrects all keyframes of a recording and returns them in the same order.
    #[must_use]
    pub fn corrected(&mut self, keyframes: Vec<Arc<Keyframe>>) -> Vec<Arc<Keyframe>> {
        let mut released: Vec<Change> = Vec::new();
        for keyframe in keyframes {
            released.extend(self.push(Change::Accepted(keyframe)));
        }
        released.extend(self.finish());
        released.into_iter().filter_map(accepted_keyframe).collect()
    }

    /// Applies the current correction to the pose of a camera that was computed from the reported
    /// base pose.
    pub(crate) fn corrected_pose(&self, camera: &str, world_from_camera: &Transform) -> Transform {
        if self.carried.contains(camera) {
            self.map_from_odom * world_from_camera
        } else {
            *world_from_camera
        }
    }

    /// The current correction of reported base poses.
    pub(crate) fn map_from_odom(&self) -> Transform {
        self.map_from_odom
    }

    /// Reports on all stations after the first.
    #[must_use]
    pub fn reports(&self) -> &[StationReport] {
        &self.reported
    }

    /// Total time spent on registration.
    #[must_use]
    pub fn spent(&self) -> Duration {
        self.spent
    }

    /// Processes queued changes. `wait_for_search`: whether to wait for a registration in progress.
    fn process_queue(&mut self, wait_for_search: bool, released: &mut Vec<Change>) {
        loop {
            // The result is applied before the next change is taken. Changes that arrived during
            // the search were queued, so the order of keyframes does not depend on how long the
            // search took.
            if let Some(search) = self
                .search
                .take_if(|search| wait_for_search || search.is_finished())
            {
                // If registration fails, only the correction of this station is lost.
                let search_result = search.join().unwrap_or_else(|_| {
                    log::error!("registering a station panicked: this is a bug");
                    SearchResult {
                        correction: None,
                        took: Duration::ZERO,
                    }
                });
                self.apply_result(search_result, released);
            }
            if self.search.is_some() {
                return;
            }
            let Some(change) = self.queue.pop_front() else {
                return;
            };
            self.take(change, released);
        }
    }

    fn take(&mut self, change: Change, released: &mut Vec<Change>) {
        // If a keyframe shows that the scan is over, registration starts without this keyframe. The
        // keyframe is put back and belongs to the next group. If no more keyframes arrive,
        // `advance_to` ends the scan after a time limit.
        let ends_group = match &change {
            Change::Accepted(keyframe) => {
                self.is_overdue(keyframe.stamp) || self.leaves_station(keyframe)
            }
            Change::Evicted { .. } => false,
        };
        if ends_group {
            self.start_search(released);
            self.queue.push_front(change);
            return;
        }
        match change {
            // If no keyframes are queued, keyframes of the current station pass at once. While an
            // arm scans from one place, its keyframes are therefore trained without delay.
            Change::Accepted(keyframe)
                if self.held.is_empty() && self.is_at_current_station(&keyframe) =>
            {
                released.push(Change::Accepted(self.placed(keyframe)));
            }
            // An eviction must not overtake the keyframe that it evicts, so it waits behind the
            // queued keyframes.
            change if self.held.is_empty() && matches!(change, Change::Evicted { .. }) => {
                released.push(change)
            }
            change => {
                self.held.push(change);
                if self.is_group_complete() || self.held.len() >= MAX_HELD {
                    self.start_search(released);
                }
            }
        }
    }

    /// Whether there are enough keyframes to register the next station, and to decide on the result.
    fn is_group_complete(&self) -> bool {
        let usable = || self.group().filter(|keyframe| is_usable(keyframe));
        if usable().count() < MIN_KEYFRAMES {
            return false;
        }
        // Validation images of both stations decide. On a slow computer, which drops keyframes, the
        // earlier stations may have only a few. A correction would then be estimated and refused.
        // Whether the images overlap is only known after registration, so this is a lower bound.
        let references = self.reference_keyframes.iter().map(|keyframe| &**keyframe);
        let n_validation = references
            .chain(usable())
            .filter(|keyframe| keyframe.split == Split::Validation)
            .count();
        n_validation >= MIN_VALIDATION_IMAGES
    }

    /// Whether a keyframe was taken at the current station or does not depend on the base.
    fn is_at_current_station(&self, keyframe: &Keyframe) -> bool {
        match &keyframe.base {
            None => true,
            Some(base_state) => self.station.is_none() || base_state.station == self.station,
        }
    }

    /// Whether a keyframe shows that the base has left the station that is being collected.
    fn leaves_station(&self, keyframe: &Keyframe) -> bool {
        let next = self.group().next().and_then(station_of);
        keyframe.base.is_some() && next.is_some() && station_of(keyframe) != next
    }

    /// Whether the queued keyframes have waited too long at the time `now`.
    fn is_overdue(&self, now: Stamp) -> bool {
        let waited_secs = |first: Option<&Keyframe>| first.map(|first| now.secs_since(first.stamp));
        // A scan has begun as soon as one held keyframe is at a station. From then on, the shorter
        // limit of a scan applies, counted from that keyframe.
        match (
            waited_secs(self.group().next()),
            waited_secs(self.held_keyframes().next()),
        ) {
            (Some(scan_secs), _) => scan_secs > MAX_SCAN_SECS,
            (None, Some(travel_secs)) => travel_secs > MAX_TRAVEL_SECS,
            (None, None) => false,
        }
    }

    fn held_keyframes(&self) -> impl Iterator<Item = &Keyframe> {
        self.held.iter().filter_map(|change| match change {
            Change::Accepted(keyframe) => Some(keyframe.as_ref()),
            Change::Evicted { .. } => None,
        })
    }

    /// The queued keyframes of the next station.
    fn group(&self) -> impl Iterator<Item = &Keyframe> {
        self.held_keyframes()
            .filter(|keyframe| station_of(keyframe).is_some())
    }

    /// Starts to register the next station. If no queued keyframe is at a station, passes them with
    /// the current correction.
    fn start_search(&mut self, released: &mut Vec<Change>) {
        let guess = self.map_from_odom;
        let Some(base_state) = self
            .group()
            .next()
            .and_then(|keyframe| keyframe.base.clone())
        else {
            for change in std::mem::take(&mut self.held) {
                released.push(corrected(change, |_| guess));
            }
            return;
        };
        // Registration starts from the current correction, because the drift since the last station
        // is much smaller than the drift since the start.
        let new: Vec<Arc<Keyframe>> = self
            .group()
            .filter(|keyframe| is_usable(keyframe))
            .map(|keyframe| Arc::new(keyframe.with_base_correction(&guess)))
            .collect();
        // The task gets copies (of `Arc`s), so that keyframes can be queued while it runs.
        let reference_keyframes = self.reference_keyframes.clone();
        let world_from_base = guess * base_state.world_from_base;
        self.search = Some(Task::start("station", move || {
            let started = Instant::now();
            let correction = run_in_background_pool(|| {
                register_station(&reference_keyframes, &new, &world_from_base)
            });
            SearchResult {
                correction,
                took: started.elapsed(),
            }
        }));
    }

    /// Passes the queued keyframes on with the correction that registration estimated.
    fn apply_result(
        &mut self,
        SearchResult { correction, took }: SearchResult,
        released: &mut Vec<Change>,
    ) {
        self.spent += took;
        let base_state = self
            .group()
            .next()
            .and_then(|keyframe| keyframe.base.clone());
        let base_state = base_state.expect("the keyframes of the registered station are queued");
        let before = self.map_from_odom;
        let correction_change = CorrectionChange {
            left: self.world_from_base,
            arrived: base_state.world_from_base,
            before,
            estimated: correction.as_ref(),
        };
        let now = correction_change.at(&base_state.world_from_base, 1.0);
        // The report counts the keyframes of the group, so it is made before the keyframes are
        // taken out.
        let report = StationReport::new(
            &base_state,
            [&before, &now],
            self.group().filter(|of| is_usable(of)).count(),
            correction.as_ref(),
        );
        log::info!("{report}");
        self.reported.push(report);
        let held: Vec<Change> = std::mem::take(&mut self.held)
            .into_iter()
            .map(|held| corrected(held, |at| correction_change.of(at)))
            .collect();
        self.station = base_state.station;
        self.world_from_base = base_state.world_from_base;
        self.map_from_odom = now;
        // Keyframes of this station become references for later ones, with their corrected poses.
        for change in &held {
            if let Change::Accepted(keyframe) = change {
                self.add_reference(keyframe);
            }
        }
        released.extend(held);
    }

    /// Corrects a keyframe of the current station.
    fn placed(&mut self, keyframe: Arc<Keyframe>) -> Arc<Keyframe> {
        let Some(base_state) = &keyframe.base else {
            return keyframe;
        };
        if base_state.station.is_some() {
            self.station = base_state.station;
            self.world_from_base = base_state.world_from_base;
        }
        let keyframe = carried(&keyframe, &self.map_from_odom);
        self.add_reference(&keyframe);
        keyframe
    }

    fn add_reference(&mut self, keyframe: &Arc<Keyframe>) {
        if station_of(keyframe).is_none() || !is_usable(keyframe) {
            return;
        }
        self.reference_keyframes.push(Arc::clone(keyframe));
        if self.reference_keyframes.len() > MAX_REFERENCE_KEYFRAMES {
            // Keyframes are sorted by split first, so that thinning keeps keyframes of both splits.
            self.reference_keyframes
                .sort_by_key(|keyframe| (keyframe.split == Split::Validation, keyframe.stamp));
            let mut ixs = 0..;
            self.reference_keyframes
                .retain(|_| ixs.next().is_some_and(|ix| ix % 2 == 0));
        }
    }
}

/// The keyframe of a change that adds one.
fn accepted_keyframe(change: Change) -> Option<Arc<Keyframe>> {
    match change {
        Change::Accepted(keyframe) => Some(keyframe),
        Change::Evicted { .. } => None,
    }
}

fn station_of(keyframe: &Keyframe) -> Option<usize> {
    keyframe.base.as_ref()?.station
}

/// Whether a keyframe can be used for registration.
fn is_usable(keyframe: &Keyframe) -> bool {
    // Test keyframes must not influence decisions, or their scores would be too good.
    keyframe.depth.is_some() && keyframe.split != Split::Test
}

/// Distance between two poses of a base. One radian counts as one meter.
fn distance(one: &Transform, other: &Transform) -> f64 {
    // A radian counts as a meter, because wheel odometry drifts in rotation as well as in
    // translation, and only the ratio of two such distances is used.
    (one.translation.vector - other.translation.vector).norm()
        + one.rotation.angle_to(&other.rotation)
}

fn carried(keyframe: &Arc<Keyframe>, map_from_odom: &Transform) -> Arc<Keyframe> {
    // Without a correction the keyframe stays bit-identical.
    if *map_from_odom == Transform::identity() {
        keyframe.clone()
    } else {
        Arc::new(keyframe.with_base_correction(map_from_odom))
    }
}

fn corrected(change: Change, correction: impl Fn(&BaseState) -> Transform) -> Change {
    match change {
        Change::Accepted(keyframe) => Change::Accepted(match &keyframe.base {
            Some(base_state) => carried(&keyframe, &correction(base_state)),
            None => keyframe,
        }),
        Change::Evicted { .. } => change,
    }
}

impl StationReport {
    fn new(
        base_state: &BaseState,
        [before, after]: [&Transform; 2],
        n_keyframes: usize,
        correction: Option<&StationCorrection>,
    ) -> Self {
        let base_error = base_state.truth.map(|truth| {
            [before, after].map(|map_from_odom| {
                PoseDistance::between(&(map_from_odom * base_state.world_from_base), &truth)
            })
        });
        Self {
            station: base_state.station.unwrap_or_default(),
            n_keyframes,
            correction: correction.cloned(),
            base_error,
        }
    }
}

impl std::fmt::Display for StationReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "base at station {}: ", self.station)?;
        match &self.correction {
            None => f.write_str(
                "its images do not overlap with earlier ones; the previous correction is kept",
            )?,
            Some(correction) if correction.kept => write!(f, "{correction}")?,
            // With fewer images, the uncertainty of the gain is unknown.
            Some(correction) if correction.n_validation_images < MIN_VALIDATION_IMAGES => write!(
                f,
                "the previous correction is kept, because this one can be checked on {} only, and {MIN_VALIDATION_IMAGES} are needed: \
                 {correction}",
                counted(correction.n_validation_images as u64, "validation image")
            )?,
            Some(correction) => write!(
                f,
                "the previous correction is kept, as this one is uncertain or not significant: {correction}"
            )?,
        }
        for unobservable in self
            .correction
            .iter()
            .flat_map(|correction| &correction.unobservable)
        {
            write!(f, "; not observable: {unobservable}")?;
        }
        if let Some([before, after]) = self.base_error {
            write!(f, "; error {before} before, {after} after")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use keyframe::DepthMap;
    use nalgebra::Vector3;

    /// A room corner with textured walls, rendered from a camera pose: brightness and depth.
    fn render_room(pose: &Transform) -> (Vec<u8>, Vec<f32>) {
        let (mut rgba, mut depth_m) = (Vec::new(), Vec::new());
        let origin = pose.translation.vector;
        for pixel in 0..SIZE_PX[0] * SIZE_PX[1] {
            let [x, y] = [pixel % SIZE_PX[0], pixel / SIZE_PX[0]].map(|px| f64::from(px) + 0.5);
            let direction =
                pose.rotation * Vector3::new((x - 80.0) / FOCAL_PX, (y - 60.0) / FOCAL_PX, 1.0);
            let walls = [
                (Vector3::x(), 2.0),
                (Vector3::y(), 1.1),
                (-Vector3::y(), 1.2),
                (Vector3::new(0.3, 0.2, -1.0), 0.9),
            ];
            let depth_along = |(normal, offset): &(Vector3<f64>, f64)| {
                let z = (offset - normal.dot(&origin)) / normal.dot(&direction);
                if z > 0.0 { z } else { f64::INFINITY }
            };
            let z = walls.iter().map(depth_along).fold(f64::INFINITY, f64::min);
            let at = origin + direction * z;
            let wave =
                |size: f64, x: f64, y: f64, z: f64| size * (x * at.x + y * at.y + z * at.z).sin();
            let level = 128.0
                + wave(30.0, 9.0, 13.0, -8.0)
                + wave(30.0, -6.0, 7.0, 15.0)
                + wave(25.0, 4.0, -5.0, 3.0);
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "a gray level in a test"
            )]
            let level = level.round() as u8;
            rgba.extend([level, level, level, 255]);
            #[expect(clippy::cast_possible_truncation, reason = "meters in a test")]
            depth_m.push(if z.is_finite() { z as f32 } else { 0.0 });
        }
        (rgba, depth_m)
    }

    const SIZE_PX: [u32; 2] = [160, 120];
    const FOCAL_PX: f64 = 120.0;

    /// True base pose: at one station, on the way, at another station.
    fn true_base(fraction: f64) -> Transform {
        Transform::new(
            Vector3::new(0.5 * fraction, 0.1 * fraction, 0.0),
            Vector3::new(0.0, 0.0, 0.15 * fraction),
        )
    }

    /// Error of the reported base pose, which grows on the way.
    fn reported_base(fraction: f64) -> Transform {
        let truth = true_base(fraction);
        let rotation = nalgebra::UnitQuaternion::from_scaled_axis(
            Vector3::new(0.003, -0.004, 0.014) * fraction,
        );
        Transform::from_parts(
            (truth.translation.vector + Vector3::new(0.012, -0.015, 0.005) * fraction).into(),
            rotation * truth.rotation,
        )
    }

    /// The `ix`-th keyframe at 2 Hz: ten seconds at a station, three on the way, ten at the next
    /// station.
    fn keyframe(ix: usize) -> Arc<Keyframe> {
        let (station, fraction) = match ix {
            0..24 => (Some(0), 0.0),
            24..30 => (None, (ix as f64 - 23.0) / 7.0),
            _ => (Some(1), 1.0),
        };
        let wave = |hz: f64, phase: f64| (hz * ix as f64 + phase).sin();
        let base_from_camera = Transform::from_parts(
            Vector3::new(
                0.15 * wave(0.9, 0.0),
                0.2 * wave(0.7, 1.0),
                0.3 + 0.1 * wave(0.5, 2.0),
            )
            .into(),
            nalgebra::UnitQuaternion::from_scaled_axis(Vector3::z() * (0.4 * wave(0.8, 0.5)))
                * nalgebra::UnitQuaternion::from_matrix(&nalgebra::Matrix3::from_columns(&[
                    -Vector3::y(),
                    -Vector3::z(),
                    Vector3::x(),
                ])),
        );
        let (rgba, depth_m) = render_room(&(true_base(fraction) * base_from_camera));
        let world_from_camera = reported_base(fraction) * base_from_camera;
        let lens = ([FOCAL_PX; 2], [80.0, 60.0]);
        Arc::new(Keyframe {
            camera: "wrist".into(),
            stamp: Stamp::from_secs(0.5 * ix as f64),
            size_px: SIZE_PX,
            focal_px: lens.0,
            principal_px: lens.1,
            rgba_srgb: rgba.into(),
            depth: Some(DepthMap {
                size_px: SIZE_PX,
                focal_px: lens.0,
                principal_px: lens.1,
                depth_m: depth_m.into(),
                world_from_camera,
            }),
            world_from_camera,
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: Some(BaseState {
                station,
                world_from_base: reported_base(fraction),
                map_from_odom: Transform::identity(),
                truth: Some(true_base(fraction)),
            }),
            split: Split::of(ix),
            truth: None,
            robot: None,
        })
    }

    fn all() -> Vec<Arc<Keyframe>> {
        (0..54).map(keyframe).collect()
    }

    fn stations() -> Stations {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/mobile-arm.toml");
        Stations::new(&Rig::load(&path, &[]).unwrap()).expect("its base moves")
    }

    /// Error of a keyframe's base pose, millimeters and degrees.
    fn base_error(keyframe: &Keyframe) -> (f64, f64) {
        let base_state = keyframe.base.as_ref().unwrap();
        let base = base_state.map_from_odom * base_state.world_from_base;
        let left = base_state.truth.unwrap().inverse() * base;
        (
            1e3 * left.translation.vector.norm(),
            left.rotation.angle().to_degrees(),
        )
    }

    fn bits(keyframes: &[Arc<Keyframe>]) -> Vec<String> {
        let shown = |keyframe: &Arc<Keyframe>| {
            format!(
                "{:?} {:?} {:?}",
                keyframe.stamp, keyframe.world_from_camera, keyframe.base
            )
        };
        keyframes.iter().map(shown).collect()
    }

    #[test]
    fn reason_of_a_rejection_is_stated() {
        let report = |n_validation_images: usize, kept: bool| {
            let correction = StationCorrection {
                translation_m: [0.01, 0.0, 0.0],
                translation_sigma_m: [0.001; 3],
                rotation_rad: [0.0; 3],
                rotation_sigma_rad: [0.001; 3],
                unobservable: Vec::new(),
                gain_db: 1.0,
                standard_error_db: 0.1,
                n_validation_images,
                n_pairs: 20,
                kept,
            };
            StationReport {
                station: 2,
                n_keyframes: 30,
                correction: Some(correction),
                base_error: None,
            }
            .to_string()
        };
        let too_few = report(MIN_VALIDATION_IMAGES - 1, false);
        assert!(
            too_few.contains("can be checked on 3 validation images only, and 4 are needed")
                && !too_few.contains("not significant"),
            "{too_few}"
        );
        let one = report(1, false);
        assert!(one.contains("on 1 validation image only"), "{one}");
        let uncertain = report(MIN_VALIDATION_IMAGES, false);
        assert!(
            uncertain.contains("uncertain or not significant"),
            "{uncertain}"
        );
        let kept = report(MIN_VALIDATION_IMAGES, true);
        assert!(kept.starts_with("base at station 2: moved by"), "{kept}");
    }

    #[test]
    fn keyframes_of_a_drifted_station_are_corrected_in_order() {
        let given = all();
        let mut stations = stations();
        let released = stations.corrected(given.clone());
        let stamps = |keyframes: &[Arc<Keyframe>]| {
            keyframes
                .iter()
                .map(|keyframe| keyframe.stamp)
                .collect::<Vec<_>>()
        };
        assert_eq!(stamps(&given), stamps(&released));
        assert!(
            given[..24]
                .iter()
                .zip(&released)
                .all(|(given, released)| Arc::ptr_eq(given, released)),
            "keyframes of the first station are unchanged"
        );
        for (given, released) in given.iter().zip(&released).skip(24) {
            let ((before_mm, _), (mm, degrees)) = (base_error(given), base_error(released));
            assert!(
                mm < 0.5 && degrees < 0.05,
                "{:?}: {before_mm} mm, now {mm} mm, {degrees}",
                released.stamp
            );
            // Depth is corrected too.
            let [was, is] = [given, released].map(|of| {
                of.world_from_camera.inverse() * of.depth.as_ref().unwrap().world_from_camera
            });
            assert!((was.to_homogeneous() - is.to_homogeneous()).abs().max() < 1e-9);
        }
        let [report] = stations.reports() else {
            panic!("{:?}", stations.reports())
        };
        let [before, after] = report.base_error.unwrap();
        assert!(
            report.station == 1 && before.m > 0.019 && after.m < 5e-4 && after.rad < 1e-3,
            "{report}"
        );
        assert!(
            report
                .to_string()
                .starts_with("base at station 1: moved by"),
            "{report}"
        );
        let camera = Transform::translation(0.1, 0.2, 0.3);
        assert_ne!(stations.corrected_pose("wrist", &camera), camera);
        assert_eq!(stations.corrected_pose("of the room", &camera), camera);
    }

    #[test]
    fn station_is_held_until_its_correction_can_be_checked() {
        // The first station has one validation image. The 14 usable keyframes with which the next
        // station could be registered have two. The fourth one is the 20th usable keyframe.
        let faster = |ix: usize| {
            Arc::new(Keyframe {
                stamp: Stamp::from_secs(0.25 * ix as f64),
                ..(*keyframe(ix)).clone()
            })
        };
        let mut stations = stations();
        let released = stations.corrected((18..54).map(faster).collect());
        assert_eq!(released.len(), 36);
        let [report] = stations.reports() else {
            panic!("{:?}", stations.reports())
        };
        assert_eq!(report.n_keyframes, 20);
        let n_validation = report.correction.as_ref().map(|of| of.n_validation_images);
        assert!(n_validation >= Some(MIN_VALIDATION_IMAGES), "{report}");
    }

    #[test]
    fn restarted_source_begins_without_a_correction() {
        let mut stations = stations();
        let first_round = stations.corrected(all());
        assert!(base_error(&all()[53]).0 > 15.0 && base_error(&first_round[53]).0 < 0.5);
        assert!(stations.restart().is_empty(), "nothing is queued");
        let second_round = stations.corrected(all());
        assert_eq!(
            bits(&second_round[..24]),
            bits(&all()[..24]),
            "the first station is uncorrected"
        );
        assert!(
            base_error(&second_round[53]).0 < 0.5,
            "{:?}",
            base_error(&second_round[53])
        );
    }

    #[test]
    fn incremental_and_batch_correction_agree() {
        let at_once = stations().corrected(all());
        for patience in [0.0, 0.05] {
            let mut stations = stations();
            let mut released = Vec::new();
            for keyframe in all() {
                let stamp = keyframe.stamp;
                released.extend(stations.push(Change::Accepted(keyframe)));
                std::thread::sleep(Duration::from_secs_f64(patience));
                released.extend(stations.advance_to(stamp));
            }
            released.extend(stations.finish());
            let released: Vec<_> = released
                .into_iter()
                .filter_map(|change| {
                    if let Change::Accepted(keyframe) = change {
                        Some(keyframe)
                    } else {
                        None
                    }
                })
                .collect();
            assert_eq!(bits(&at_once), bits(&released));
        }
    }

    #[test]
    fn held_keyframes_are_released_in_order_after_a_limit() {
        let mut stations = stations();
        let count = |released: &[Change]| released.len();
        for keyframe in all().into_iter().take(24) {
            assert_eq!(
                count(&stations.push(Change::Accepted(keyframe))),
                1,
                "the first station is not queued"
            );
        }
        let evicted = || Change::Evicted {
            camera: "wrist".into(),
            stamp: Stamp(0),
        };
        assert_eq!(count(&stations.push(evicted())), 1);
        assert!(
            stations.push(Change::Accepted(keyframe(25))).is_empty(),
            "on the way"
        );
        assert!(stations.push(evicted()).is_empty());
        assert!(stations.advance_to(Stamp::from_secs(30.0)).is_empty());
        let released = stations.advance_to(Stamp::from_secs(12.5 + MAX_TRAVEL_SECS + 1.0));
        assert!(
            matches!(&released[..], [Change::Accepted(_), Change::Evicted { .. }]),
            "{}",
            released.len()
        );
        // A scan with too few keyframes is registered once it has lasted long enough.
        for ix in 40..44 {
            assert!(stations.push(Change::Accepted(keyframe(ix))).is_empty());
        }
        let late = Stamp::from_secs(20.0 + MAX_SCAN_SECS + 1.0);
        let mut released = stations.advance_to(late);
        while released.is_empty() {
            std::thread::sleep(Duration::from_millis(10));
            released = stations.advance_to(late);
        }
        assert_eq!((released.len(), stations.reports().len()), (4, 1));
        let Change::Accepted(keyframe) = &released[0] else {
            panic!("a keyframe")
        };
        assert!(
            stations.reports()[0]
                .correction
                .as_ref()
                .is_none_or(|correction| !correction.kept || base_error(keyframe).0 < 2.0)
        );
    }

    #[test]
    fn station_without_overlap_is_kept_and_reported() {
        let away =
            |keyframe: Arc<Keyframe>| match keyframe.base.as_ref().and_then(|base| base.station) {
                Some(1) => {
                    Arc::new(keyframe.with_base_correction(&Transform::translation(90.0, 0.0, 0.0)))
                }
                _ => keyframe,
            };
        let given: Vec<_> = all().into_iter().map(away).collect();
        let mut stations = stations();
        let released = stations.corrected(given.clone());
        assert_eq!(bits(&given), bits(&released));
        assert!(
            stations.reports()[0]
                .to_string()
                .contains("do not overlap with earlier ones"),
            "{}",
            stations.reports()[0]
        );
    }

    #[test]
    fn only_moving_bases_are_realigned_on_request() {
        let rig = |name: &str, realign: bool| {
            let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
                .join("../rigs")
                .join(name);
            Rig::load(
                &path,
                &[crate::config::Override::new("base.realign", realign)],
            )
            .unwrap()
        };
        assert!(Stations::new(&rig("mobile-arm.toml", false)).is_none());
        assert!(Stations::new(&rig("static-arm.toml", true)).is_none());
    }
}
