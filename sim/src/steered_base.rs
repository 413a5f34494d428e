//! A simulated base that an operator takes over from its tour.
//!
//! Until the operator begins, the base moves on its tour. It then brakes, and follows the
//! velocities of the thread that drives it, in real time. The thread of the simulation may lag
//! behind, because it renders: it follows the same path when it gets there.

use crate::base::{BaseMotion, smooth};
use drivers::base_motion::{BaseReport, BaseVelocity, MovableBase};
use kinematics::{Stamp, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use parking_lot::{Condvar, Mutex};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// How long a velocity lasts without a newer one.
const VALID_NANOS: i64 = 100_000_000;
/// Number of velocities that are kept for the simulation: those of two minutes. A simulation that
/// is later than this has stopped.
const MAX_LEGS: usize = 6000;
/// Time for which the past path is kept, because cameras and scanners may still need it,
/// nanoseconds.
const PAST_NANOS: i64 = 5_000_000_000;
/// Maximum time to wait for a velocity, after which the base counts as abandoned and stands still.
const MAX_WAIT: Duration = Duration::from_secs(2);
/// Time over which a velocity on the tour is measured, nanoseconds.
const TOUR_STEP_NANOS: i64 = 1_000_000;
/// Duration in which the bounce and sway of the tour fade out, nanoseconds.
const LEVEL_NANOS: f64 = 1e9;

/// A simulated base that an operator may drive. Clones refer to the same base.
#[derive(Clone, Debug)]
pub struct SteeredBase {
    path: BasePath,
    n_contacts: Option<Arc<AtomicU64>>,
}

impl SteeredBase {
    pub(crate) fn new(path: BasePath, n_contacts: Option<Arc<AtomicU64>>) -> Self {
        Self { path, n_contacts }
    }

    /// Ends the tour: the base brakes, and then follows velocities.
    pub fn begin(&self) {
        self.path.0.state.lock().is_wanted = true;
    }

    /// True pose of the base at a time, on the clock of the thread that drives it.
    #[must_use]
    pub fn world_from_base(&self, at: Stamp) -> Transform {
        let Shared { start, tour, .. } = &*self.path.0;
        let nanos = at.nanos_since(*start);
        let steered = self.path.world_from_base(nanos);
        steered.unwrap_or_else(|| tour.world_from_base(nanos as f64 * 1e-9))
    }

    /// How often a part of the robot has touched a part of the scene; `None` if it is not counted.
    #[must_use]
    pub fn n_contacts(&self) -> Option<u64> {
        let n_contacts = self.n_contacts.as_ref()?;
        Some(n_contacts.load(Ordering::Relaxed))
    }
}

/// The path of a base, shared by the simulation and the thread that drives the base. Times are
/// simulated nanoseconds.
#[derive(Clone, Debug)]
pub(crate) struct BasePath(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    /// Stamp of simulated time zero, on the clock of the driving thread.
    start: Stamp,
    tour: BaseMotion,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    is_wanted: bool,
    /// Time of the newest step of the simulation.
    simulated_nanos: i64,
    /// The end of the tour.
    tour_end: Option<TourEnd>,
    /// The path since then, in the order of time.
    legs: VecDeque<Leg>,
    /// Whether nobody drives the base any more.
    is_abandoned: bool,
}

#[derive(Clone, Copy, Debug)]
struct TourEnd {
    nanos: i64,
    /// From the level frame at the place of the base to the base, with bounce and sway.
    level_from_base: Transform,
    /// Height of the base link of a base at rest, meters.
    rest_z_m: f64,
    walked_frac: f64,
}

/// A part of the path with one velocity.
#[derive(Clone, Copy, Debug)]
struct Leg {
    nanos: i64,
    /// x, y in meters and heading in radians, at the start.
    place: [f64; 3],
    velocity: BaseVelocity,
    /// Length of the path since the end of the tour, meters.
    walked_m: f64,
}

impl Leg {
    /// The place at a time of this leg.
    fn at(&self, nanos: i64) -> Self {
        let lasted_nanos = (nanos - self.nanos).clamp(0, VALID_NANOS);
        let secs = lasted_nanos as f64 * 1e-9;
        let [x, y, yaw] = self.place;
        let turned = self.velocity.yaw_rad_s * secs;
        // The path at constant velocities is an arc, whose chord points in the direction at half of
        // the turn. The chord is shorter than the arc by the sinc of half of the turn.
        let (sin, cos) = (yaw + 0.5 * turned).sin_cos();
        let half = 0.5 * turned;
        let sinc = if half.abs() < 1e-6 {
            1.0
        } else {
            half.sin() / half
        };
        let forward_m = self.velocity.forward_m_s * secs * sinc;
        let left_m = self.velocity.left_m_s * secs * sinc;
        Self {
            nanos,
            place: [
                x + forward_m * cos - left_m * sin,
                y + forward_m * sin + left_m * cos,
                yaw + turned,
            ],
            velocity: if lasted_nanos < VALID_NANOS {
                self.velocity
            } else {
                BaseVelocity::ZERO
            },
            walked_m: self.walked_m + self.velocity.speed_m_s() * secs,
        }
    }
}

impl BasePath {
    /// A base on its tour.
    ///
    /// * `start`: simulated time zero on the clock of the thread that drives the base.
    pub(crate) fn new(start: Stamp, tour: BaseMotion) -> Self {
        Self(Arc::new(Shared {
            start,
            tour,
            state: Mutex::default(),
            changed: Condvar::new(),
        }))
    }

    /// The base, for the thread that drives it.
    pub(crate) fn driven(&self) -> Box<dyn MovableBase> {
        Box::new(DrivenBase(self.clone()))
    }

    /// For the simulation: the robot steps to a time. Waits until the path to this time is known.
    pub(crate) fn step(&self, nanos: i64) {
        let mut state = self.0.state.lock();
        state.simulated_nanos = nanos;
        let Some(end) = state.tour_end else {
            return;
        };
        state.forget_before(nanos - PAST_NANOS);
        while nanos > end.nanos && !state.is_abandoned && state.known_until() < nanos {
            if self.0.changed.wait_for(&mut state, MAX_WAIT).timed_out() {
                state.is_abandoned = true;
            }
        }
    }

    /// Whether the operator has the base.
    pub(crate) fn has_begun(&self) -> bool {
        self.0.state.lock().tour_end.is_some()
    }

    /// Pose of the base at a time after its tour; `None` on the tour.
    pub(crate) fn world_from_base(&self, nanos: i64) -> Option<Transform> {
        let state = self.0.state.lock();
        let end = state.tour_end.filter(|end| nanos > end.nanos)?;
        let [x, y, yaw] = state.leg_at(nanos)?.place;
        let share = smooth((nanos - end.nanos) as f64 / LEVEL_NANOS);
        let z_m = end.level_from_base.translation.z;
        let tilt = end.level_from_base.rotation.scaled_axis() * (1.0 - share);
        let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        Some(Transform::from_parts(
            Translation3::new(x, y, z_m + (end.rest_z_m - z_m) * share),
            heading * UnitQuaternion::from_scaled_axis(tilt),
        ))
    }

    /// Completed fraction of the tour at a time after the tour, if the base had walked on along it;
    /// `None` on the tour.
    ///
    /// * `tour_m`: length of the tour.
    pub(crate) fn walked_frac(&self, nanos: i64, tour_m: f64) -> Option<f64> {
        let state = self.0.state.lock();
        let end = state.tour_end.filter(|end| nanos > end.nanos)?;
        Some(end.walked_frac + state.leg_at(nanos)?.walked_m / tour_m)
    }
}

impl State {
    fn end_tour(&mut self, nanos: i64, tour: &BaseMotion) {
        let secs = nanos as f64 * 1e-9;
        let world_from_base = tour.world_from_base(secs);
        let place = place_of(&world_from_base);
        let [x, y, yaw] = place;
        let world_from_level = Transform::from_parts(
            Translation3::new(x, y, 0.0),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw),
        );
        self.is_abandoned = false;
        self.tour_end = Some(TourEnd {
            nanos,
            level_from_base: world_from_level.inverse() * world_from_base,
            rest_z_m: tour.rest_z_m(),
            walked_frac: tour.walked_frac(secs),
        });
        self.legs.push_back(Leg {
            nanos,
            place,
            velocity: tour_velocity(tour, nanos),
            walked_m: 0.0,
        });
    }

    fn known_until(&self) -> i64 {
        self.legs.back().map_or(i64::MIN, |leg| leg.nanos)
    }

    fn leg_at(&self, nanos: i64) -> Option<Leg> {
        let n_before = self.legs.partition_point(|leg| leg.nanos <= nanos);
        let leg = self.legs.get(n_before.saturating_sub(1))?;
        Some(leg.at(nanos))
    }

    /// Removes legs that ended before a time.
    fn forget_before(&mut self, nanos: i64) {
        while self.legs.get(1).is_some_and(|next| next.nanos <= nanos) {
            self.legs.pop_front();
        }
    }
}

/// The velocity of the tour at a time.
fn tour_velocity(tour: &BaseMotion, nanos: i64) -> BaseVelocity {
    let at = |nanos: i64| place_of(&tour.world_from_base(nanos as f64 * 1e-9));
    let [x0, y0, yaw0] = at(nanos - TOUR_STEP_NANOS);
    let [x1, y1, yaw1] = at(nanos);
    let secs = TOUR_STEP_NANOS as f64 * 1e-9;
    let (x_m_s, y_m_s) = ((x1 - x0) / secs, (y1 - y0) / secs);
    let (sin, cos) = yaw1.sin_cos();
    let turned = (yaw1 - yaw0).sin().atan2((yaw1 - yaw0).cos());
    BaseVelocity {
        forward_m_s: x_m_s * cos + y_m_s * sin,
        left_m_s: y_m_s * cos - x_m_s * sin,
        yaw_rad_s: turned / secs,
    }
}

/// x, y and heading of a pose.
fn place_of(world_from_base: &Transform) -> [f64; 3] {
    let forward = world_from_base.rotation * Vector3::x();
    let place = world_from_base.translation;
    [place.x, place.y, forward.y.atan2(forward.x)]
}

/// The side of the thread that drives the base. Dropping it leaves the base where it is.
struct DrivenBase(BasePath);

impl DrivenBase {
    fn simulated(&self, now: Stamp) -> i64 {
        now.nanos_since(self.0.0.start)
    }
}

impl Drop for DrivenBase {
    fn drop(&mut self) {
        self.0.0.state.lock().is_abandoned = true;
        self.0.0.changed.notify_all();
    }
}

impl MovableBase for DrivenBase {
    fn drive(&mut self, now: Stamp, velocity: &BaseVelocity) -> Result<(), drivers::Error> {
        let nanos = self.simulated(now);
        let mut state = self.0.0.state.lock();
        state.is_abandoned = false;
        // The tour may have been simulated ahead of real time, so its end may be a while away.
        let Some(last) = state.legs.back().filter(|leg| leg.nanos < nanos).copied() else {
            return Ok(());
        };
        if nanos - last.nanos > VALID_NANOS {
            // The thread was stalled, so the base has stopped meanwhile.
            let stopped = last.at(last.nanos + VALID_NANOS);
            state.legs.push_back(stopped);
        }
        state.legs.push_back(Leg {
            velocity: *velocity,
            ..last.at(nanos)
        });
        while state.legs.len() > MAX_LEGS {
            state.legs.pop_front();
        }
        self.0.0.changed.notify_all();
        Ok(())
    }

    fn report(&mut self, now: Stamp) -> BaseReport {
        let nanos = self.simulated(now);
        let tour = &self.0.0.tour;
        let mut state = self.0.0.state.lock();
        if state.is_wanted && state.tour_end.is_none() {
            // What was simulated already stays as it was.
            let end_nanos = nanos.max(state.simulated_nanos);
            state.end_tour(end_nanos, tour);
        }
        let is_on_tour = state.tour_end.is_none_or(|end| nanos < end.nanos);
        let velocity = match state.legs.back() {
            Some(leg) if !is_on_tour => leg.at(nanos).velocity,
            _ => tour_velocity(tour, nanos),
        };
        BaseReport {
            reported_at: Some(now),
            velocity,
            is_stop_confirmed: !is_on_tour && velocity == BaseVelocity::ZERO,
            is_on_tour,
            fault: None,
            refusal: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::config::{Config, Parent, Scene};
    use drivers::Base;
    use drivers::base_motion::{BaseDrive, BaseLimits, BaseOutput, BaseTarget};
    use drivers::clock;
    use std::time::Instant;

    const START: Stamp = Stamp(5_000_000_000);
    const STEP_NANOS: i64 = 1_000_000;

    fn stamp(nanos: i64) -> Stamp {
        Stamp(START.0 + nanos)
    }

    /// A base that is taken over at a time of its tour, and the thread that drives it.
    fn taken_over(tour: BaseMotion, nanos: i64) -> (BasePath, Box<dyn MovableBase>) {
        let path = BasePath::new(START, tour);
        let base = SteeredBase::new(path.clone(), None);
        let mut driven = path.driven();
        path.step(nanos - STEP_NANOS);
        assert!(driven.report(stamp(nanos - STEP_NANOS)).is_on_tour);
        base.begin();
        assert!(!driven.report(stamp(nanos)).is_on_tour);
        assert!(path.has_begun());
        (path, driven)
    }

    #[test]
    fn what_was_simulated_ahead_of_real_time_stays_as_it_was() {
        let path = BasePath::new(START, BaseMotion::Lap(1.0));
        let mut driven = path.driven();
        path.step(7_000_000_000);
        SteeredBase::new(path.clone(), None).begin();
        let report = driven.report(stamp(6_800_000_000));
        assert!(report.is_on_tour && !report.is_stop_confirmed, "{report:?}");
        assert_eq!(path.world_from_base(7_000_000_000), None);
        let base = SteeredBase::new(path.clone(), None);
        let tour = BaseMotion::Lap(1.0);
        let at_start = base.world_from_base(stamp(6_900_000_000));
        assert_eq!(at_start, tour.world_from_base(6.9));
        let result = driven.drive(stamp(6_820_000_000), &BaseVelocity::ZERO);
        result.expect("a simulated base is always reached");
        let report = driven.report(stamp(7_000_000_000));
        assert!(!report.is_on_tour && report.velocity.speed_m_s() > 0.2);
    }

    #[test]
    fn the_path_continues_from_the_tour_without_a_jump_and_ends_level() {
        let tour = BaseMotion::Lap(1.0);
        let began_nanos = 7_000_000_000;
        let (path, mut driven) = taken_over(tour, began_nanos);
        let velocity = driven.report(stamp(began_nanos + 1)).velocity;
        assert!(velocity.speed_m_s() > 0.2, "{velocity:?}");
        let mut before = tour.world_from_base(began_nanos as f64 * 1e-9);
        // The base brakes in a second.
        for step in 1..=100_i64 {
            let nanos = began_nanos + step * 20_000_000;
            let left = (1.0 - step as f64 / 50.0).max(0.0);
            let braked = velocity.to_array().map(|number| number * left);
            let driven = driven.drive(stamp(nanos), &BaseVelocity::from_array(braked));
            driven.expect("a simulated base is always reached");
            path.step(nanos);
            let pose = path.world_from_base(nanos).expect("after the tour");
            let moved_m = (pose.translation.vector - before.translation.vector).norm();
            assert!(moved_m < 0.03, "{moved_m} m in 20 ms");
            before = pose;
        }
        let up = before.rotation * Vector3::z();
        assert!((up.z - 1.0).abs() < 1e-12, "{up}");
        assert!((before.translation.z - tour.rest_z_m()).abs() < 1e-12);
        assert!(driven.report(stamp(9_100_000_000)).is_stop_confirmed);
        let tour_m = 14.0;
        let walked = path.walked_frac(9_000_000_000, tour_m).expect("known");
        assert!(walked > tour.walked_frac(7.0), "the drift goes on");
    }

    #[test]
    fn velocities_move_the_base_along_arcs_and_end_without_newer_ones() {
        let tour = BaseMotion::FixedAt(Transform::identity());
        let (path, mut driven) = taken_over(tour, 1_000_000_000);
        let quarter = std::f64::consts::FRAC_PI_2;
        let velocity = BaseVelocity {
            forward_m_s: quarter,
            left_m_s: 0.0,
            yaw_rad_s: quarter,
        };
        let mut nanos = 1_000_000_000;
        for _ in 0..=50 {
            nanos += 20_000_000;
            let result = driven.drive(stamp(nanos), &velocity);
            result.expect("a simulated base is always reached");
        }
        // A second on a circle with a radius of 1 m, from the first of these velocities on.
        let pose = path.world_from_base(nanos).expect("after the tour");
        let [x, y, yaw] = place_of(&pose);
        assert!((x - 1.0).abs() < 1e-9 && (y - 1.0).abs() < 1e-9, "{x} {y}");
        assert!((yaw - quarter).abs() < 1e-9, "{yaw}");
        // Nobody drives it for a second: it moved on for 100 ms.
        drop(driven);
        path.step(nanos + 1_000_000_000);
        let pose = path.world_from_base(nanos + 1_000_000_000).expect("known");
        let [x, y, _] = place_of(&pose);
        let moved_m = (x - 1.0).hypot(y - 1.0);
        assert!((moved_m - 0.1 * quarter).abs() < 1e-3, "{moved_m}");
    }

    const LIMITS: BaseLimits = BaseLimits {
        max_forward_m_s: 0.5,
        max_left_m_s: 0.3,
        max_yaw_rad_s: 0.8,
        acceleration_m_s2: 0.5,
        yaw_acceleration_rad_s2: 1.0,
        brake_m_s2: 1.0,
        brake_yaw_rad_s2: 2.0,
    };
    /// Maximum time until something happens, on a busy machine.
    const TIMEOUT: Duration = Duration::from_secs(120);

    /// Where the rig reports its base, at the newest of the poses that have arrived.
    fn newest_place(base: &mut Box<dyn Base>) -> [f64; 3] {
        let mut pose = base.next_pose(TIMEOUT).expect("the rig runs");
        while let Ok(next) = base.next_pose(Duration::ZERO) {
            pose = next;
        }
        place_of(&pose.world_from_base)
    }

    #[test]
    fn the_base_of_a_rig_leaves_its_tour_and_obeys() {
        let mut config = Config {
            scene: Scene::MobileBase,
            joint_names: Vec::new(),
            reading_order: Vec::new(),
            truth: false,
            ..Config::default()
        };
        config.base.drift_m = 0.0;
        config.base.drift_rad = 0.0;
        config.cameras[0].parent = Parent::Base;
        config.cameras[0].intrinsics = config.cameras[0].intrinsics.resized([160, 120]);
        let rig = crate::open(&config).expect("the rig opens");
        let rig = rig.into_steered_base(None).expect("the rig starts");
        let mut poses = rig.live.devices.base.expect("it moves");
        let drive = BaseDrive::start(rig.driven, LIMITS).expect("valid limits");
        let began = Instant::now();
        let [x0, y0, _] = newest_place(&mut poses);
        loop {
            let [x, y, _] = newest_place(&mut poses);
            if (x - x0).hypot(y - y0) > 0.05 {
                break;
            }
            assert!(began.elapsed() < TIMEOUT, "it does not walk");
        }

        rig.base.begin();
        while !drive.port().state().is_some_and(|state| state.is_at_rest) {
            assert!(began.elapsed() < TIMEOUT, "{:?}", drive.port().state());
            std::thread::sleep(Duration::from_millis(5));
        }
        // Poses of the rig may still be on their path.
        let mut rest = newest_place(&mut poses);
        loop {
            let next = newest_place(&mut poses);
            if next == rest {
                break;
            }
            rest = next;
            assert!(began.elapsed() < TIMEOUT, "it does not come to rest");
        }

        // Half a meter forward, in the direction in which it stands.
        let mut serial = 0;
        let moved = loop {
            serial += 1;
            drive.port().send(&BaseOutput::Drive(BaseTarget {
                // A pause of the machine ends a motion.
                motion: drive
                    .port()
                    .state()
                    .map_or(1, |state| state.braked_motion + 1),
                serial,
                velocity: BaseVelocity {
                    forward_m_s: 0.4,
                    ..BaseVelocity::ZERO
                },
                expires_at: clock::now().plus_secs(0.2),
            }));
            let place = newest_place(&mut poses);
            let moved = [place[0] - rest[0], place[1] - rest[1]];
            if moved[0].hypot(moved[1]) > 0.5 {
                break moved;
            }
            assert!(began.elapsed() < TIMEOUT, "it does not move");
        };
        let direction = moved[1].atan2(moved[0]);
        let off_rad = (direction - rest[2]).sin().abs();
        assert!(off_rad < 1e-3, "{direction} instead of {}", rest[2]);
        drive.port().send(&BaseOutput::Brake);
        // Its end waits until it stands still.
        drop(drive);
        let mut last = newest_place(&mut poses);
        loop {
            let next = newest_place(&mut poses);
            if next == last {
                break;
            }
            last = next;
            assert!(began.elapsed() < TIMEOUT, "it does not stop");
        }
        assert!(rig.base.n_contacts().is_some(), "contacts are counted");
    }
}
