//! Corrects the pose of a moving base at each station by registering its images there with those of
//! earlier stations.
//!
//! Keyframes pass through this module on their way from the join to the trainer. Keyframes of the
//! first station pass unchanged. Later, keyframes are queued while the base moves. The first
//! keyframes of the next station are queued as well, until this station can be registered with
//! earlier stations ([`calibration::register_station`]). Then these keyframes and all later ones
//! pass with the correction.
//!
//! An operator should not have to wait for this. If the depth of a queued keyframe determines the
//! drift of the base well enough ([`DepthTracking`]), the keyframe passes at once with this
//! provisional correction, and is revised when its station is registered.
//!
//! The final poses depend only on the keyframes and their order, so that a run, its recording and
//! the replay of that recording agree. Only the time at which keyframes pass, and whether they pass
//! with a provisional correction first, depends on a clock.

mod depth_tracking;
#[cfg(test)]
mod tests;

use crate::config::{BaseDriver, Parent, Rig};
use crate::join::Change;
use crate::pose_distance::PoseDistance;
use background::{Task, run_in_background_pool};
use calibration::{MIN_VALIDATION_IMAGES, StationCorrection, register_station};
use depth_tracking::{DepthTracking, Tracked};
use keyframe::{BaseState, Keyframe, Split};
use kinematics::{Stamp, Transform, transform};
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
    /// Follows the drift between the stations.
    tracking: DepthTracking,
    /// Difference between registration and depth tracking. `None` if it is unknown, for example
    /// because the run continues an earlier one.
    map_from_tracked: Option<Transform>,
    /// Queued keyframes on the way to the next station and at it, in order.
    held: Vec<Waiting>,
    /// Changes received since registration of the next station started.
    queue: VecDeque<Waiting>,
    search: Option<Task<SearchResult>>,
    /// Whether the base is on the way to a station that is not registered yet.
    is_on_way: bool,
    /// Whether keyframes pass only with their final pose.
    is_final_only: bool,
    reported: Vec<StationReport>,
    /// Total time spent on registration.
    spent: Duration,
}

/// A change that is queued, or whose keyframe has passed with a provisional correction.
struct Waiting {
    change: Change,
    /// The correction by depth tracking; `None` if depth does not determine it.
    tracked: Option<Tracked>,
    stage: Stage,
}

/// Progress of a waiting change.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Stage {
    /// It has not passed.
    Queued,
    /// It is a keyframe, and has passed with this provisional correction.
    Provisional(Transform),
    /// It has passed, and nothing follows.
    Done,
}

impl Waiting {
    fn keyframe(&self) -> Option<&Arc<Keyframe>> {
        match &self.change {
            Change::Accepted(keyframe) => Some(keyframe),
            Change::Revised(_) | Change::Evicted { .. } => None,
        }
    }

    /// The change that must still be passed on. `corrected`: the keyframe with its final
    /// correction.
    fn settled(self, corrected: Option<Arc<Keyframe>>) -> Option<Change> {
        match (self.stage, corrected) {
            (Stage::Done, _) => None,
            (Stage::Provisional(correction), Some(keyframe)) => {
                let base_state = keyframe.base.as_ref();
                let is_final = base_state.is_some_and(|of| of.map_from_odom == correction);
                (!is_final).then_some(Change::Revised(keyframe))
            }
            (_, Some(keyframe)) => Some(Change::Accepted(keyframe)),
            (_, None) => Some(self.change),
        }
    }
}

/// Change of the base correction from the station that the base left to the new one.
struct CorrectionChange<'a> {
    /// Reported base pose at the station that the base left.
    left: Transform,
    /// Reported base pose at the new station.
    arrived: Transform,
    /// The correction before the new station.
    before: Transform,
    /// The correction at the new station by depth tracking; `None` if depth did not determine it.
    tracked: Option<Transform>,
    /// The correction that registration estimated, relative to `before`. `None` if the images do
    /// not overlap with those of earlier stations.
    estimated: Option<&'a StationCorrection>,
}

impl CorrectionChange<'_> {
    /// The correction of a base state. `tracked`: the correction there by depth tracking.
    ///
    /// Drift accumulates with the distance traveled. On the way between the two stations, a
    /// keyframe therefore gets a share of the correction in proportion to that distance.
    fn of(&self, at: &BaseState, tracked: Option<Transform>) -> Transform {
        if at.station.is_some() {
            return self.at_arrival();
        }
        let from = distance(&self.left, &at.world_from_base);
        let to = distance(&at.world_from_base, &self.arrived);
        // If the base has not moved yet, it has not drifted. The condition also avoids 0 / 0.
        let fraction = if from > 0.0 { from / (from + to) } else { 0.0 };
        match (tracked, self.tracked) {
            // The remaining error of depth tracking also grows in proportion to the distance.
            (Some(tracked), Some(at_arrival)) => {
                let missed = self.at_arrival() * at_arrival.inverse();
                transform::interpolate(&Transform::identity(), &missed, fraction) * tracked
            }
            (None, Some(at_arrival)) if !self.is_estimated() => {
                let found = at_arrival * self.before.inverse();
                transform::interpolate(&Transform::identity(), &found, fraction) * self.before
            }
            _ => self.estimated(&at.world_from_base, fraction),
        }
    }

    /// The correction at the new station.
    fn at_arrival(&self) -> Transform {
        match self.tracked {
            Some(tracked) if !self.is_estimated() => tracked,
            _ => self.estimated(&self.arrived, 1.0),
        }
    }

    /// Whether the correction by registration is used.
    fn is_estimated(&self) -> bool {
        self.estimated.is_some_and(|estimated| estimated.kept)
    }

    /// The correction by registration at a reported base pose that lies at this fraction of the
    /// path.
    fn estimated(&self, reported: &Transform, fraction: f64) -> Transform {
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
    /// How far depth tracking has moved the base since the previous station, before registration;
    /// null if depth does not determine it.
    tracked: Option<PoseDistance>,
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
            tracking: DepthTracking::new(),
            map_from_tracked: Some(Transform::identity()),
            held: Vec::new(),
            queue: VecDeque::new(),
            search: None,
            is_on_way: false,
            is_final_only: false,
            reported: Vec::new(),
            spent: Duration::ZERO,
        })
    }

    /// Passes keyframes only with their final pose, and waits for it. The order of the keyframes
    /// then does not depend on the speed of the computer. It is also necessary for models that
    /// cannot remove a keyframe.
    #[must_use]
    pub fn final_only(mut self) -> Self {
        self.is_final_only = true;
        self
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
            // The base may have been moved since then.
            self.map_from_tracked = None;
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
        let tracked = match &change {
            Change::Accepted(keyframe) => self.tracking.add(keyframe),
            Change::Revised(_) | Change::Evicted { .. } => None,
        };
        self.queue.push_back(Waiting {
            change,
            tracked,
            stage: Stage::Queued,
        });
        let mut released = Vec::new();
        self.process_queue(self.is_final_only, &mut released);
        self.pass_provisionally(&mut released);
        released
    }

    /// Passes changes that can pass before registration: keyframes whose depth determines the drift
    /// of the base, and keyframes of cameras that do not move with the base.
    fn pass_provisionally(&mut self, released: &mut Vec<Change>) {
        if self.is_final_only {
            return;
        }
        let mut waiting: Vec<&mut Waiting> = self.held.iter_mut().chain(&mut self.queue).collect();
        for ix in 0..waiting.len() {
            if waiting[ix].stage != Stage::Queued {
                continue;
            }
            let passed = match &waiting[ix].change {
                Change::Accepted(keyframe) if keyframe.base.is_none() => {
                    Some((Change::Accepted(Arc::clone(keyframe)), Stage::Done))
                }
                Change::Accepted(keyframe) => {
                    let correction = provisional(self.map_from_tracked, waiting[ix].tracked);
                    correction.map(|correction| {
                        let keyframe = carried(keyframe, &correction);
                        (Change::Accepted(keyframe), Stage::Provisional(correction))
                    })
                }
                Change::Evicted { camera, stamp } => {
                    let (camera, stamp) = (Arc::clone(camera), *stamp);
                    let is_of = |waiting: &&mut Waiting| {
                        let keyframe = waiting.keyframe();
                        keyframe.is_some_and(|of| of.camera == camera && of.stamp == stamp)
                    };
                    let evicted = waiting[..ix].iter_mut().find(|waiting| is_of(waiting));
                    // An eviction must not overtake the keyframe that it evicts.
                    let has_passed = evicted.is_none_or(|evicted| {
                        let has_passed = evicted.stage != Stage::Queued;
                        if has_passed {
                            evicted.stage = Stage::Done;
                        }
                        has_passed
                    });
                    has_passed.then_some((Change::Evicted { camera, stamp }, Stage::Done))
                }
                Change::Revised(_) => None,
            };
            if let Some((change, stage)) = passed {
                released.push(change);
                waiting[ix].stage = stage;
            }
        }
    }

    /// Updates the time, because the wait for a station is limited. `newest`: the newest stamp of
    /// all samples, on the clock of the keyframes. Returns the changes that can be passed on, in
    /// order.
    pub(crate) fn advance_to(&mut self, newest: Stamp) -> Vec<Change> {
        let mut released = Vec::new();
        self.process_queue(self.is_final_only, &mut released);
        // Images with earlier stamps have already been decided by the join.
        let settled_until = newest.plus_secs(-self.max_wait_secs);
        if self.search.is_none() && self.is_overdue(settled_until) {
            self.start_search(&mut released);
        }
        self.pass_provisionally(&mut released);
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
        self.tracking = DepthTracking::new();
        self.map_from_tracked = Some(Transform::identity());
        self.is_on_way = false;
        self.station = None;
        self.world_from_base = Transform::identity();
        self.map_from_odom = Transform::identity();
        released
    }

    /// Corrects all keyframes of a recording and returns them in the same order.
    #[must_use]
    pub fn corrected(&mut self, keyframes: Vec<Arc<Keyframe>>) -> Vec<Arc<Keyframe>> {
        self.is_final_only = true;
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
            self.map_from_odom() * world_from_camera
        } else {
            *world_from_camera
        }
    }

    /// The current correction of reported base poses. It is provisional until the station of the
    /// newest keyframe is registered.
    pub(crate) fn map_from_odom(&self) -> Transform {
        let tracked = self.tracking.newest().filter(|_| self.is_on_way);
        provisional(self.map_from_tracked, tracked).unwrap_or(self.map_from_odom)
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
            let Some(waiting) = self.queue.pop_front() else {
                return;
            };
            self.take(waiting, released);
        }
    }

    fn take(&mut self, waiting: Waiting, released: &mut Vec<Change>) {
        // If a keyframe shows that the scan is over, registration starts without this keyframe. The
        // keyframe is put back and belongs to the next group. If no more keyframes arrive,
        // `advance_to` ends the scan after a time limit.
        let keyframe = waiting.keyframe().cloned();
        let ends_group = keyframe.as_ref().is_some_and(|keyframe| {
            self.is_overdue(keyframe.stamp) || self.leaves_station(keyframe)
        });
        if ends_group {
            self.start_search(released);
            self.queue.push_front(waiting);
            return;
        }
        // If no keyframes are queued, keyframes of the current station pass at once. While an arm
        // scans from one place, its keyframes are therefore trained without delay. An eviction must
        // not overtake the keyframe that it evicts, so it waits behind the queued keyframes.
        let is_settled = self.held.is_empty()
            && keyframe
                .as_ref()
                .is_none_or(|keyframe| self.is_at_current_station(keyframe));
        if keyframe.as_ref().is_some_and(|of| of.base.is_some()) {
            self.is_on_way = !is_settled;
        }
        if is_settled {
            let placed = keyframe.map(|keyframe| self.placed(keyframe));
            released.extend(waiting.settled(placed));
            return;
        }
        self.held.push(waiting);
        if self.is_group_complete() || self.held.len() >= MAX_HELD {
            self.start_search(released);
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
        let keyframes = self.held.iter().filter_map(Waiting::keyframe);
        keyframes.map(AsRef::as_ref)
    }

    /// The queued keyframes of the next station.
    fn group(&self) -> impl Iterator<Item = &Keyframe> {
        self.held_keyframes()
            .filter(|keyframe| station_of(keyframe).is_some())
    }

    /// Starts to register the next station. If no queued keyframe is at a station, passes them with
    /// the current correction.
    fn start_search(&mut self, released: &mut Vec<Change>) {
        let before = self.map_from_odom;
        let Some(base_state) = self
            .group()
            .next()
            .and_then(|keyframe| keyframe.base.clone())
        else {
            for waiting in std::mem::take(&mut self.held) {
                let correction =
                    provisional(self.map_from_tracked, waiting.tracked).unwrap_or(before);
                let keyframe = waiting.keyframe().map(|of| corrected(of, |_| correction));
                released.extend(waiting.settled(keyframe));
            }
            return;
        };
        // Registration compares with the current correction, because the drift since the last
        // station is much smaller than the drift since the start. It begins at the result of depth
        // tracking, which is closer.
        let initial_motion = self
            .tracked_at_group()
            .map_or_else(Transform::identity, |tracked| tracked * before.inverse());
        let new: Vec<Arc<Keyframe>> = self
            .group()
            .filter(|keyframe| is_usable(keyframe))
            .map(|keyframe| Arc::new(keyframe.with_base_correction(&before)))
            .collect();
        // The task gets copies (of `Arc`s), so that keyframes can be queued while it runs.
        let reference_keyframes = self.reference_keyframes.clone();
        let world_from_base = before * base_state.world_from_base;
        self.search = Some(Task::start("station", move || {
            let started = Instant::now();
            let correction = run_in_background_pool(|| {
                register_station(
                    &reference_keyframes,
                    &new,
                    &world_from_base,
                    &initial_motion,
                )
            });
            SearchResult {
                correction,
                took: started.elapsed(),
            }
        }));
    }

    /// The correction by depth tracking at the station of the queued keyframes.
    fn tracked_at_group(&self) -> Option<Transform> {
        let at_station = |waiting: &&Waiting| {
            let keyframe = waiting.keyframe();
            keyframe.is_some_and(|keyframe| station_of(keyframe).is_some())
        };
        // The last keyframe is matched with the largest part of the station.
        let last = self.held.iter().rev().find(at_station)?;
        provisional(self.map_from_tracked, last.tracked)
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
            tracked: self.tracked_at_group(),
            estimated: correction.as_ref(),
        };
        let now = correction_change.at_arrival();
        // The report counts the keyframes of the group, so it is made before the keyframes are
        // taken out.
        let report = StationReport::new(
            &base_state,
            [&before, &now],
            self.group().filter(|of| is_usable(of)).count(),
            &correction_change,
        );
        log::info!("{report}");
        self.reported.push(report);
        let map_from_tracked = self.map_from_tracked;
        let held = std::mem::take(&mut self.held);
        // Later provisional corrections include the result of registration.
        match held.iter().rev().find_map(|waiting| waiting.tracked) {
            Some(last) => self.map_from_tracked = Some(now * last.from_odom.inverse()),
            None if now != before => self.map_from_tracked = None,
            None => {}
        }
        self.is_on_way = false;
        self.station = base_state.station;
        self.world_from_base = base_state.world_from_base;
        self.map_from_odom = now;
        for waiting in held {
            let accurate = waiting.tracked.filter(|tracked| tracked.is_accurate);
            let tracked = provisional(map_from_tracked, accurate);
            let keyframe = waiting
                .keyframe()
                .map(|of| corrected(of, |at| correction_change.of(at, tracked)));
            // Keyframes of this station become references for later ones, with their corrected
            // poses.
            keyframe.iter().for_each(|of| self.add_reference(of));
            released.extend(waiting.settled(keyframe));
        }
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

/// The provisional correction of reported poses: by depth tracking, and its difference from
/// registration.
fn provisional(map_from_tracked: Option<Transform>, tracked: Option<Tracked>) -> Option<Transform> {
    Some(map_from_tracked? * tracked?.from_odom)
}

/// The keyframe of a change that adds one.
fn accepted_keyframe(change: Change) -> Option<Arc<Keyframe>> {
    match change {
        Change::Accepted(keyframe) => Some(keyframe),
        Change::Revised(_) | Change::Evicted { .. } => None,
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

fn corrected(
    keyframe: &Arc<Keyframe>,
    correction: impl Fn(&BaseState) -> Transform,
) -> Arc<Keyframe> {
    match &keyframe.base {
        Some(base_state) => carried(keyframe, &correction(base_state)),
        None => Arc::clone(keyframe),
    }
}

impl StationReport {
    fn new(
        base_state: &BaseState,
        [before, after]: [&Transform; 2],
        n_keyframes: usize,
        change: &CorrectionChange<'_>,
    ) -> Self {
        let reported = base_state.world_from_base;
        let base_error = base_state.truth.map(|truth| {
            [before, after]
                .map(|map_from_odom| PoseDistance::between(&(map_from_odom * reported), &truth))
        });
        Self {
            station: base_state.station.unwrap_or_default(),
            n_keyframes,
            correction: change.estimated.cloned(),
            tracked: change
                .tracked
                .map(|tracked| PoseDistance::between(&(tracked * reported), &(before * reported))),
            base_error,
        }
    }
}

impl std::fmt::Display for StationReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "base at station {}: ", self.station)?;
        let kept = match self.tracked {
            Some(_) => "the correction by depth tracking",
            None => "the previous correction",
        };
        match &self.correction {
            None => write!(
                f,
                "its images do not overlap with earlier ones; {kept} is kept"
            )?,
            Some(correction) if correction.kept => write!(f, "{correction}")?,
            // With fewer images, the uncertainty of the gain is unknown.
            Some(correction) if correction.n_validation_images < MIN_VALIDATION_IMAGES => write!(
                f,
                "{kept} is kept, because this one can be checked on {} only, and {MIN_VALIDATION_IMAGES} are needed: \
                 {correction}",
                counted(correction.n_validation_images as u64, "validation image")
            )?,
            Some(correction) => write!(
                f,
                "{kept} is kept, as this one is uncertain or not significant: {correction}"
            )?,
        }
        if let Some(tracked) = self.tracked {
            write!(f, "; depth tracking moved it by {tracked}")?;
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
