//! What is known about the space around the robot of a run: the map of free space, and what feeds
//! it.
//!
//! Keyframes with measured depth show what is free and what is not; for the others, the live model
//! draws depth (`clearance_feed.rs`). Scans of range scanners show the same. Before the first operator, the
//! space through which the arm itself moves is free, too, with the margin that the rig file permits:
//! a person guides it, or a simulated arm is on its tour.

use super::base::RobotWatch;
use super::observer::RobotObserver;
use super::robot::ChainAndBody;
use super::undrawn::UndrawnKeyframes;
use capture::config::Rig;
use capture::open;
use clearance_map::{
    ClearanceMap, DepthImage, DepthOrigin, MapBase, MapConfig, Posture, images_of_scan, reach_m,
};
use drivers::motion::ArmState;
use keyframe::{Keyframe, RangeScan, RobotState};
use kinematics::{JointHistory, JointState, Stamp, Transform};
use nalgebra::Point3;
use parking_lot::Mutex;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};
use steering::{Body, Clearance, Footprint, Seen};

/// Postures are not interpolated across longer gaps.
const MAX_GAP: Duration = Duration::from_millis(100);
/// Number of postures kept: those of five seconds at 1 kHz. Keyframes take less time to arrive.
const MAX_POSTURES: usize = 5000;
/// Time between two reported postures that are swept. The arm of a tour moves by less than the
/// margin.
const SWEEP_PERIOD_SECS: f64 = 0.2;
/// Minimum time from a reading that is swept to all other swept postures. Readings are swept only
/// where reports are missing.
const GAP_SECS: f64 = 0.15;
/// Number of swept postures whose times are kept: several minutes.
const MAX_SWEPT: usize = 1000;
/// Margin of swept space in simulations, meters. Their tours keep this distance from the scene.
const SIMULATED_MARGIN_M: f64 = 0.15;

/// Distance from a base up to which its surroundings are in the map, meters, besides its footprint:
/// a base at 0.6 m/s stops within 0.8 m.
const BASE_REACH_M: f64 = 1.2;
/// Minimum time between two scans of a scanner that are used, seconds: each one is four images.
const SCAN_PERIOD_SECS: f64 = 0.2;
/// Change of the correction of base poses after which the map is outdated, meters and radians.
/// Smaller changes are within the distances that the robot keeps.
const MAX_SHIFT_M: f64 = 0.05;
const MAX_SHIFT_RAD: f64 = 0.05;

/// The space around a robot.
pub(crate) struct SceneClearance {
    map: ClearanceMap,
    /// Index in the lists of the rig file of each joint of the chain.
    joint_ixs: Vec<usize>,
    place: Place,
    swept_margin_m: f64,
    state: Mutex<State>,
    undrawn: UndrawnKeyframes,
}

struct State {
    /// Postures in the order of the chain.
    postures: JointHistory,
    /// The newest one; empty before the first one.
    newest_position: Vec<f64>,
    sweep: Sweep,
    /// Time of the last scan of each scanner.
    scanned: BTreeMap<Arc<str>, Stamp>,
    /// The last correction of base poses.
    map_from_odom: Option<Transform>,
}

/// Where the base of the robot is.
enum Place {
    /// The base does not move.
    Fixed(Transform),
    Moving(Arc<RobotWatch>),
}

/// A base in the map, and the newest reports about it.
pub(super) struct MovingBase<'a> {
    pub(super) in_map: &'a MapBase,
    pub(super) watch: Arc<RobotWatch>,
}

/// The times of the postures that have shown free space.
#[derive(Debug, Default)]
struct Sweep {
    swept: BTreeSet<Stamp>,
    newest_report: Option<Stamp>,
    /// Time of the newest report when an operator took the arm over.
    ended_at: Option<Stamp>,
}

impl SceneClearance {
    /// The space around the robot of a rig, of which nothing is known.
    ///
    /// * `robot`: its chain and its shapes; `None` for a base of which only the footprint is known.
    /// * `base`: the base, if it is steered.
    ///
    /// # Errors
    ///
    /// If the reach of the robot is too large for a map, or no thread can be started.
    pub(super) fn new(
        rig: &Rig,
        robot: Option<&ChainAndBody>,
        base: Option<MovingBase<'_>>,
    ) -> anyhow::Result<Self> {
        let settings = rig.arm.motion.as_ref().map(|motion| &motion.steering);
        let permitted_m = settings.map_or(0.0, |settings| settings.swept_margin_m);
        let swept_margin_m = if open::is_any_simulated(rig) {
            permitted_m.max(SIMULATED_MARGIN_M)
        } else {
            permitted_m
        };
        let footprint = base.as_ref().map(|base| &base.in_map.footprint);
        let body = body(rig, robot, footprint);
        let of_arm_m: f64 = robot.map_or(0.0, |robot| reach_m(&robot.body, &robot.chain));
        let of_base_m = footprint.map_or(0.0, |it| it.radius_m() + BASE_REACH_M);
        // Beyond the largest map, nothing is seen.
        let reach_m = of_arm_m.max(of_base_m.min(MapConfig::max_reach_m()));
        let config = MapConfig::for_reach(reach_m);
        let map = match &base {
            Some(base) => ClearanceMap::start_with_base(&config, body, base.in_map)?,
            None => ClearanceMap::start(&config, body)?,
        };
        let joint_ixs = robot.map(|robot| robot.chain.order_in(&rig.arm.joints));
        Ok(Self {
            map,
            joint_ixs: joint_ixs.transpose()?.unwrap_or_default(),
            place: match base {
                Some(base) => Place::Moving(base.watch),
                None => Place::Fixed(rig.base.world_from_base),
            },
            swept_margin_m,
            state: Mutex::new(State {
                postures: JointHistory::new(MAX_GAP, MAX_POSTURES),
                newest_position: Vec::new(),
                sweep: Sweep::default(),
                scanned: BTreeMap::new(),
                map_from_odom: None,
            }),
            undrawn: UndrawnKeyframes::default(),
        })
    }

    /// Sets where the arm is now, in the order of the chain.
    pub(super) fn set_posture(&self, arm: &ArmState) {
        self.set_robot(arm.reported_at, &arm.position);
    }

    /// Sets where a base without a steered arm is now.
    pub(super) fn set_base(&self) {
        let Place::Moving(watch) = &self.place else {
            return;
        };
        let Some((at, _)) = watch.newest_pose() else {
            return;
        };
        // An arm that is not steered is where the input has reported it last.
        let position = self.state.lock().newest_position.clone();
        self.set_robot(at, &position);
    }

    fn set_robot(&self, at: Stamp, position: &[f64]) {
        let Some(world_from_base) = self.newest_base(at) else {
            return;
        };
        let posture = Posture {
            stamp: at,
            position: position.to_vec(),
            world_from_base,
        };
        let is_due = self.state.lock().sweep.takes_report(at);
        let result = self.map.set_posture(&posture).and_then(|()| {
            // The robot reports its state also while the input waits for a busy trainer.
            if is_due {
                self.map.sweep(posture, self.swept_margin_m)
            } else {
                Ok(())
            }
        });
        if let Err(error) = result {
            // The chain of decisions brakes because of the same report.
            log::debug!("steering: {error}");
        }
    }

    /// From now on, an operator moves the robot, so that its own way proves nothing any more.
    pub(super) fn end_sweep(&self) {
        self.state.lock().sweep.end();
    }

    /// Takes a reading of the joints and of the base.
    pub(super) fn observe_robot(&self, robot: &RobotState) {
        self.note_correction();
        let of_chain = |ix: &usize| robot.positions.get(*ix).copied();
        let Some(position) = self
            .joint_ixs
            .iter()
            .map(of_chain)
            .collect::<Option<Vec<_>>>()
        else {
            return;
        };
        let mut state = self.state.lock();
        let is_due = state.sweep.takes_reading(robot.stamp);
        let swept = is_due.then(|| Posture {
            stamp: robot.stamp,
            position: position.clone(),
            world_from_base: match &self.place {
                Place::Fixed(world_from_base) => *world_from_base,
                Place::Moving(_) => robot.world_from_base,
            },
        });
        state.newest_position.clone_from(&position);
        // Readings that are not later than the last one are counted by the history.
        let _ = state.postures.push(JointState {
            stamp: robot.stamp,
            position,
            velocity: Vec::new(),
            effort: Vec::new(),
        });
        drop(state);
        if let Some(posture) = swept
            && let Err(error) = self.map.sweep(posture, self.swept_margin_m)
        {
            log::debug!("steering: {error}");
        }
    }

    /// Takes a scan of a range scanner.
    pub(super) fn observe_range_scan(&self, live: &RangeScan) {
        let scan = &live.scan;
        {
            let mut state = self.state.lock();
            let last = state.scanned.get(&scan.scanner);
            if last.is_some_and(|last| scan.stamp.secs_since(*last) < SCAN_PERIOD_SECS) {
                return;
            }
            state.scanned.insert(Arc::clone(&scan.scanner), scan.stamp);
        }
        let Some(posture) = self.posture_at(scan.stamp) else {
            log::debug!("steering: no posture at the time of a scan");
            return;
        };
        let corrected = |point: &[f32; 3]| {
            let point = Point3::from(point.map(f64::from));
            (live.map_from_odom * point).into()
        };
        let points: Vec<[f64; 3]> = scan.points_in_world_m.iter().map(corrected).collect();
        let world_from_scanner = live.map_from_odom * scan.world_from_scanner;
        let name = format!("scanner {}", scan.scanner);
        for image in images_of_scan(&name, &world_from_scanner, &points, &posture) {
            self.observe_depth(image);
        }
    }

    /// Takes a keyframe. If most of its pixels have no depth, it waits for that of the model.
    pub(super) fn observe_keyframe(&self, keyframe: &Keyframe) {
        let Some(posture) = self.posture_at(keyframe.stamp) else {
            log::debug!("steering: no posture at the time of a keyframe");
            return;
        };
        if keyframe.lacks_dense_depth() {
            self.undrawn.push(keyframe, posture.clone(), Instant::now());
        }
        let Some(depth) = &keyframe.depth else {
            return;
        };
        self.observe_depth(DepthImage {
            camera: Arc::clone(&keyframe.camera),
            stamp: keyframe.stamp,
            size_px: depth.size_px,
            focal_px: depth.focal_px,
            principal_px: depth.principal_px,
            depth_m: Arc::clone(&depth.depth_m),
            world_from_camera: depth.world_from_camera,
            posture,
            origin: DepthOrigin::Measured,
        });
    }

    /// Keyframes whose depth is to be drawn.
    pub(super) fn undrawn(&self) -> &UndrawnKeyframes {
        &self.undrawn
    }

    /// Takes a depth image.
    pub(super) fn observe_depth(&self, image: DepthImage) {
        if let Err(error) = self.map.push(image) {
            log::debug!("steering: {error}");
        }
    }

    /// Posture and place of the robot at a time of the past.
    fn posture_at(&self, stamp: Stamp) -> Option<Posture> {
        let position = if self.joint_ixs.is_empty() {
            Vec::new()
        } else {
            self.state.lock().postures.at(stamp).ok()?.position
        };
        Some(Posture {
            stamp,
            position,
            world_from_base: match &self.place {
                Place::Fixed(world_from_base) => *world_from_base,
                Place::Moving(watch) => watch.world_from_base(stamp)?,
            },
        })
    }

    /// Place of the base at a time that may be later than its last report.
    fn newest_base(&self, at: Stamp) -> Option<Transform> {
        match &self.place {
            Place::Fixed(world_from_base) => Some(*world_from_base),
            Place::Moving(watch) => {
                let newest = || {
                    watch
                        .newest_pose()
                        .map(|(_, world_from_base)| world_from_base)
                };
                watch.world_from_base(at).or_else(newest)
            }
        }
    }

    /// Forgets the map if the correction of base poses has changed by more than the distances that
    /// the robot keeps.
    fn note_correction(&self) {
        let Place::Moving(watch) = &self.place else {
            return;
        };
        let Some(newest) = watch.map_from_odom() else {
            return;
        };
        let before = self.state.lock().map_from_odom.replace(newest);
        let Some(before) = before else {
            return;
        };
        let shift = before.inverse() * newest;
        let is_large =
            shift.translation.vector.norm() > MAX_SHIFT_M || shift.rotation.angle() > MAX_SHIFT_RAD;
        if is_large {
            log::warn!(
                "steering: the pose of the base was corrected by {:.2} m, so the map of free space begins anew",
                shift.translation.vector.norm()
            );
            self.map.forget();
        } else {
            // Small corrections add up, so they are compared with the first one.
            self.state.lock().map_from_odom = Some(before);
        }
    }
}

/// The shape of the robot in the map.
fn body(rig: &Rig, robot: Option<&ChainAndBody>, footprint: Option<&Footprint>) -> Body {
    match (robot, footprint) {
        (Some(robot), _) => robot.body.clone(),
        (None, footprint) => {
            let capsules = footprint.map_or(Vec::new(), Footprint::capsules);
            Body::of_base(&rig.arm.base_link, &capsules)
        }
    }
}

impl Sweep {
    /// Whether the posture of a report is swept. It then counts as swept.
    fn takes_report(&mut self, at: Stamp) -> bool {
        self.newest_report = Some(at);
        let last = self.swept.last();
        let is_due = last.is_none_or(|last| at.secs_since(*last) >= SWEEP_PERIOD_SECS);
        self.take(at, is_due && self.ended_at.is_none())
    }

    /// Whether the posture of a reading is swept. It then counts as swept. Readings may arrive late,
    /// also after the end, but none of them is missing after the program was stalled.
    fn takes_reading(&mut self, at: Stamp) -> bool {
        let is_in_time = self.ended_at.is_none_or(|end| at <= end);
        let is_far = |other: Option<&Stamp>| {
            other.is_none_or(|other| at.secs_since(*other).abs() >= GAP_SECS)
        };
        let is_in_gap =
            is_far(self.swept.range(..=at).next_back()) && is_far(self.swept.range(at..).next());
        self.take(at, is_in_time && is_in_gap)
    }

    fn take(&mut self, at: Stamp, is_due: bool) -> bool {
        if is_due {
            self.swept.insert(at);
            if self.swept.len() > MAX_SWEPT {
                self.swept.pop_first();
            }
        }
        is_due
    }

    fn end(&mut self) {
        // Without a report, nothing is known about the way of the arm.
        self.ended_at = Some(self.newest_report.unwrap_or(Stamp(i64::MIN)));
    }
}

impl Clearance for SceneClearance {
    fn readings(&self, points_in_base: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        self.map.readings(points_in_base, now)
    }

    fn base_readings(&self, points_in_base: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        self.map.base_readings(points_in_base, now)
    }

    fn failure(&self) -> Option<String> {
        self.map.failure()
    }
}

impl RobotObserver for SceneClearance {
    fn observe_robot(&self, state: &RobotState) {
        Self::observe_robot(self, state); // The function of the map itself.
    }

    fn observe_keyframe(&self, keyframe: &Arc<Keyframe>) {
        Self::observe_keyframe(self, keyframe);
    }

    fn observe_range_scan(&self, scan: &RangeScan) {
        Self::observe_range_scan(self, scan);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::steering::robot::chain_and_body;
    use keyframe::{DepthMap, Split};
    use kinematics::Transform;
    use std::path::Path;

    const START: [f64; 7] = [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];
    const AT: Stamp = Stamp(1_000_000_000);
    /// Maximum time until the map has integrated something, on a busy machine.
    const TIMEOUT: Duration = Duration::from_secs(60);

    /// The clearance of a simulated arm, and a point 10 cm beside its tip at [`START`].
    fn simulated() -> (SceneClearance, [f64; 3]) {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
        let rig = Rig::load(&file, &[]).expect("a rig of this repository");
        let robot = chain_and_body(&rig).expect("its shapes are in the URDF");
        let scene = SceneClearance::new(&rig, Some(&robot), None).expect("a map of its reach");
        let base_from_tip = robot.chain.forward(&START).expect("seven joints");
        let tip = base_from_tip.translation;
        (scene, [tip.x, tip.y + 0.1, tip.z])
    }

    fn reading_at(stamp: Stamp) -> RobotState {
        RobotState {
            stamp,
            captured_at: Instant::now(),
            world_from_base: Transform::identity(),
            positions: START.to_vec(),
        }
    }

    fn is_known(scene: &SceneClearance, point: [f64; 3]) -> bool {
        scene.readings(&[point], AT.plus_secs(1.0))[0].is_some()
    }

    fn wait_until_known(scene: &SceneClearance, point: [f64; 3]) {
        let began = Instant::now();
        while !is_known(scene, point) {
            assert!(began.elapsed() < TIMEOUT, "{point:?} is still unknown");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// The state of an arm that moves.
    fn arm_at(stamp: Stamp) -> ArmState {
        ArmState {
            reported_at: stamp,
            position: START.to_vec(),
            is_at_rest: false,
            braked_motion: 0,
            stopped: None,
        }
    }

    #[test]
    fn the_way_of_the_arm_is_free_until_an_operator_has_it() {
        let (scene, beside_tip) = simulated();
        assert!(!is_known(&scene, beside_tip));
        scene.set_posture(&arm_at(AT));
        wait_until_known(&scene, beside_tip);
        assert!(
            !is_known(&scene, [beside_tip[0], beside_tip[1] + 0.4, beside_tip[2]]),
            "it was not there"
        );
        scene.end_sweep();
        scene.set_posture(&arm_at(Stamp(2 * AT.0)));
        let swept = scene.state.lock().sweep.swept.clone();
        assert_eq!(swept, BTreeSet::from([AT]), "the tour has ended");
    }

    #[test]
    fn readings_fill_the_gaps_between_reports_also_after_the_end() {
        let at = |secs| AT.plus_secs(secs);
        let mut sweep = Sweep::default();
        // The program is stalled for 0.8 s, and an operator then takes the arm over.
        let reports = [0.0, 0.1, 0.2, 1.0].map(|secs| sweep.takes_report(at(secs)));
        assert_eq!(reports, [true, false, true, true]);
        sweep.end();
        let readings = [0.1, 0.3, 0.4, 0.5, 0.6, 0.8, 0.9, 1.1, 1.4];
        let swept = readings.map(|secs| sweep.takes_reading(at(secs)));
        let expected = [false, false, true, false, true, true, false, false, false];
        assert_eq!(swept, expected);
        assert!(!sweep.takes_report(at(1.5)), "the tour has ended");
    }

    #[test]
    fn a_posture_that_only_the_input_reports_shows_free_space() {
        let (scene, beside_tip) = simulated();
        scene.observe_robot(&reading_at(AT));
        wait_until_known(&scene, beside_tip);
    }

    #[test]
    fn keyframes_with_depth_show_free_space_in_front_of_their_surfaces() {
        const SIZE_PX: [u32; 2] = [64, 48];
        let (scene, _) = simulated();
        scene.end_sweep();
        // Before and after the keyframe, so that its posture is known.
        for nanos in [0, 20_000_000] {
            scene.observe_robot(&reading_at(Stamp(AT.0 + nanos)));
        }
        // The camera stands beside the arm, looks along x, and sees a wall at a distance of 1 m.
        let looks_along_x = nalgebra::UnitQuaternion::face_towards(
            &nalgebra::Vector3::x(),
            &-nalgebra::Vector3::z(),
        );
        let world_from_camera =
            Transform::from_parts(nalgebra::Translation3::new(-0.3, 0.5, 0.5), looks_along_x);
        let n_px = (SIZE_PX[0] * SIZE_PX[1]) as usize;
        let keyframe = Keyframe {
            camera: "front".into(),
            stamp: Stamp(AT.0 + 10_000_000),
            size_px: SIZE_PX,
            focal_px: [60.0; 2],
            principal_px: [32.0, 24.0],
            rgba_srgb: vec![255; 4 * n_px].into(),
            depth: Some(DepthMap {
                size_px: SIZE_PX,
                focal_px: [60.0; 2],
                principal_px: [32.0, 24.0],
                depth_m: vec![1.0; n_px].into(),
                world_from_camera,
            }),
            world_from_camera,
            twist: None,
            readout_secs: 0.0,
            joint_twists: Arc::default(),
            base: None,
            split: Split::Train,
            truth: None,
            robot: None,
        };
        scene.observe_keyframe(&keyframe);
        wait_until_known(&scene, [0.2, 0.5, 0.5]);
        assert!(!is_known(&scene, [0.9, 0.5, 0.5]), "behind the wall");
    }
}
