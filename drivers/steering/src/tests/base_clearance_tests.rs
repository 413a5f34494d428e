//! A base among obstacles, with a simulated clock: it stops before surfaces and before space that was
//! never seen, wherever its operator drives or sends it.

use super::{ANA, PAD};
use crate::{
    BaseClearanceConfig, BaseSituation, BaseSteeringConfig, BaseVerdict, Clearance, Command,
    Effect, FloorPose, Footprint, Intent, Link, Reason, Request, Seen, SeenPose, Setup, Situation,
    Steering,
};
use drivers::base_motion::{BaseFollower, BaseLimits, BaseOutput, BaseState};
use kinematics::Stamp;
use numbers::random::Random;
use std::cell::Cell;
use std::collections::VecDeque;

const CYCLE_SECS: f64 = 0.02;
/// Number of cycles from a pose to the report of it: 100 ms.
const POSE_DELAY: usize = 5;
const LIMITS: BaseLimits = BaseLimits {
    max_forward_m_s: 0.5,
    max_left_m_s: 0.3,
    max_yaw_rad_s: 0.8,
    acceleration_m_s2: 0.4,
    yaw_acceleration_rad_s2: 0.8,
    brake_m_s2: 0.8,
    brake_yaw_rad_s2: 1.6,
};
const HALF_LENGTH_M: f64 = 0.4;
const HALF_WIDTH_M: f64 = 0.25;
/// As of the map of free space.
const MAX_DISTANCE_M: f64 = 0.25;
/// Half of the side of the room, meters.
const ROOM_M: f64 = 2.0;
/// A post in the room: x, y and radius, meters.
const POST: [f64; 3] = [1.0, 0.6, 0.1];
const START: FloorPose = FloorPose {
    x_m: -0.8,
    y_m: 0.0,
    yaw_rad: 0.0,
};

/// A room with a post, of which everything at |y| < `seen_m` was seen at a time.
struct Room {
    /// The last reported pose, in whose frame points are.
    pose: Cell<FloorPose>,
    seen_at: Cell<Stamp>,
    seen_m: Cell<f64>,
}

impl Room {
    /// Distance of a point of the floor from everything that is not free; negative inside.
    fn distance_m(&self, x: f64, y: f64) -> f64 {
        let walls_m = ROOM_M - x.abs().max(y.abs());
        let post_m = (x - POST[0]).hypot(y - POST[1]) - POST[2];
        walls_m.min(post_m).min(self.seen_m.get() - y.abs())
    }
}

impl Clearance for Room {
    fn readings(&self, _points: &[[f64; 3]], _now: Stamp) -> Vec<Option<Seen>> {
        Vec::new()
    }

    fn base_readings(&self, points: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        let pose = self.pose.get();
        let own = footprint();
        let reading = |[x, y, _]: &[f64; 3]| {
            let (sin, cos) = pose.yaw_rad.sin_cos();
            let at = [pose.x_m + x * cos - y * sin, pose.y_m + x * sin + y * cos];
            // The space of the base itself is free, as in the map.
            let distance_m = self.distance_m(at[0], at[1]).max(own.depth_m([*x, *y]));
            (distance_m > 0.0).then(|| Seen {
                distance_m: distance_m.min(MAX_DISTANCE_M),
                age_secs: now.secs_since(self.seen_at.get()).max(0.0),
            })
        };
        points.iter().map(reading).collect()
    }
}

fn footprint() -> Footprint {
    let (x, y) = (HALF_LENGTH_M, HALF_WIDTH_M);
    Footprint::of_points(&[[-x, -y], [x, -y], [x, y], [-x, y]], [-0.2, 0.3]).unwrap()
}

fn config() -> BaseSteeringConfig {
    BaseSteeringConfig {
        clearance: Some(BaseClearanceConfig::new(footprint())),
        ..BaseSteeringConfig::new(LIMITS)
    }
}

/// A chain and a base that has the velocities of its follower, and whose pose is reported late.
struct Sim {
    steering: Steering,
    room: Room,
    follower: BaseFollower,
    pose: FloorPose,
    poses: VecDeque<SeenPose>,
    now: Stamp,
    sequence: u64,
    n_grips: u64,
}

impl Sim {
    fn new(config: BaseSteeringConfig) -> Self {
        let mut sim = Self {
            steering: Steering::of_base(config).unwrap(),
            room: Room {
                pose: Cell::new(START),
                seen_at: Cell::new(Stamp(0)),
                seen_m: Cell::new(10.0),
            },
            follower: BaseFollower::new(LIMITS).unwrap(),
            pose: START,
            poses: VecDeque::new(),
            now: Stamp(1_000_000_000),
            sequence: 0,
            n_grips: 1,
        };
        let take = Request::TakeLease(ANA);
        sim.steering.handle(sim.now, &take).unwrap();
        sim.send(None, velocity(0.0, 0.0, 0.0));
        sim.cycle();
        sim
    }

    fn send(&mut self, grip: Option<u64>, intent: Intent) {
        self.sequence += 1;
        let command = Command {
            operator: ANA,
            device: PAD,
            sequence: self.sequence,
            captured_at: self.now,
            received_at: self.now,
            grip,
            intent,
        };
        let _ = self.steering.handle(self.now, &Request::Command(command));
    }

    fn cycle(&mut self) -> BaseVerdict {
        self.now = self.now.plus_secs(CYCLE_SECS);
        let seen = self.poses.front().copied().unwrap_or(SeenPose {
            at: self.now,
            pose: START,
            z_m: 0.5,
        });
        self.room.pose.set(seen.pose);
        let situation = Situation {
            arm: None,
            base: Some(BaseSituation {
                base: BaseState {
                    reported_at: self.now,
                    velocity: self.follower.velocity(),
                    is_at_rest: self.follower.is_at_rest(),
                    braked_motion: self.follower.braked_motion(),
                    fault: None,
                    refusal: None,
                },
                pose: Some(seen),
                arm: None,
            }),
        };
        let decision = self.steering.decide(self.now, &situation, &self.room);
        let verdict = decision.base.unwrap();
        match &verdict.output {
            BaseOutput::Drive(target) => self.follower.follow(self.now, target).unwrap(),
            BaseOutput::Brake => self.follower.brake(self.follower.braked_motion()),
        }
        let velocity = self.follower.step(self.now);
        let (sin, cos) = self.pose.yaw_rad.sin_cos();
        let pose = &mut self.pose;
        pose.x_m += CYCLE_SECS * (velocity.forward_m_s * cos - velocity.left_m_s * sin);
        pose.y_m += CYCLE_SECS * (velocity.forward_m_s * sin + velocity.left_m_s * cos);
        pose.yaw_rad += CYCLE_SECS * velocity.yaw_rad_s;
        self.poses.push_back(SeenPose {
            at: self.now,
            pose: *pose,
            z_m: 0.5,
        });
        if self.poses.len() > POSE_DELAY {
            self.poses.pop_front();
        }
        verdict
    }

    /// Drives with a held switch. The scene is always seen.
    fn drive(&mut self, n_cycles: u32, intent: &Intent) -> BaseVerdict {
        let mut last = None;
        for _ in 0..n_cycles {
            self.room.seen_at.set(self.now);
            self.send(Some(self.n_grips), intent.clone());
            last = Some(self.cycle());
        }
        last.unwrap()
    }

    /// Distance of the true footprint from everything that is not free.
    fn gap_m(&self) -> f64 {
        const N: u32 = 20;
        let mut gap_m = f64::INFINITY;
        let (sin, cos) = self.pose.yaw_rad.sin_cos();
        for ix in 0..=N {
            for row in 0..=N {
                let x = HALF_LENGTH_M * (2.0 * f64::from(ix) / f64::from(N) - 1.0);
                let y = HALF_WIDTH_M * (2.0 * f64::from(row) / f64::from(N) - 1.0);
                let at = [
                    self.pose.x_m + x * cos - y * sin,
                    self.pose.y_m + x * sin + y * cos,
                ];
                gap_m = gap_m.min(self.room.distance_m(at[0], at[1]));
            }
        }
        gap_m
    }
}

fn velocity(forward: f64, left: f64, yaw: f64) -> Intent {
    Intent::BaseVelocity {
        velocity: [forward, left, yaw],
    }
}

fn goal(x: f64, y: f64, yaw: f64) -> Intent {
    Intent::BaseGoal {
        world_from_goal: [x, y, yaw],
    }
}

fn clearance_of(verdict: &BaseVerdict) -> Option<(Effect, &Reason)> {
    let mut limits = verdict.limits.iter();
    let limit = limits.find(|limit| limit.link == Link::Clearance)?;
    Some((limit.effect, &limit.reason))
}

#[test]
fn the_base_stops_before_a_wall_and_may_leave_it() {
    let mut sim = Sim::new(config());
    let verdict = sim.drive(600, &velocity(0.5, 0.0, 0.0));
    assert!(sim.follower.is_at_rest() || sim.follower.velocity().speed_m_s() < 1e-3);
    let gap_m = sim.gap_m();
    // It keeps the stop distance, the radius of the spheres and the step along its way.
    assert!(gap_m > 0.03 && gap_m < 0.2, "{gap_m}");
    let (effect, reason) = clearance_of(&verdict).expect("a limit");
    assert_eq!(effect, Effect::Refused);
    let place = reason.place().expect("the place of the wall");
    assert!(place[0] > sim.pose.x_m + HALF_LENGTH_M - 0.05, "{place:?}");
    let x_m = sim.pose.x_m;
    sim.drive(100, &velocity(-0.3, 0.0, 0.0));
    assert!(sim.pose.x_m < x_m - 0.2, "it may leave the wall");
}

#[test]
fn nothing_is_touched_and_no_unseen_space_entered_whatever_the_operator_does() {
    for seed in 0..12 {
        let mut random = Random::new(seed);
        let mut sim = Sim::new(config());
        sim.room.seen_m.set(1.6);
        let mut traveled_m = 0.0;
        let mut intent = velocity(0.5, 0.0, 0.0);
        for step in 0..2500 {
            if step % 120 == 0 {
                intent = if random.below(3) == 0 {
                    goal(
                        random.uniform(-3.0, 3.0),
                        random.uniform(-3.0, 3.0),
                        random.uniform(-3.0, 3.0),
                    )
                } else {
                    velocity(
                        random.uniform(-0.6, 0.6),
                        random.uniform(-0.4, 0.4),
                        random.uniform(-1.0, 1.0),
                    )
                };
                sim.n_grips += 1;
            }
            let before = sim.pose;
            sim.drive(1, &intent);
            traveled_m += (sim.pose.x_m - before.x_m).hypot(sim.pose.y_m - before.y_m);
            let gap_m = sim.gap_m();
            assert!(
                gap_m > 0.0,
                "seed {seed}, step {step}: {gap_m} at {:?}",
                sim.pose
            );
        }
        assert!(traveled_m > 2.0, "seed {seed}: {traveled_m}");
    }
}

#[test]
fn a_goal_behind_an_obstacle_is_approached_and_refused_with_its_place() {
    let mut sim = Sim::new(config());
    let verdict = sim.drive(1500, &goal(POST[0] + 0.6, POST[1], 0.0));
    assert!(!verdict.has_arrived);
    assert!(sim.pose.x_m > START.x_m + 0.3, "it has driven there");
    let (effect, reason) = clearance_of(&verdict).expect("a limit");
    assert_eq!(effect, Effect::Refused);
    let place = reason.place().expect("the place of the post");
    let off_m = (place[0] - POST[0]).hypot(place[1] - POST[1]);
    assert!(off_m < 0.5, "{place:?}");
    // A goal in free space is reached.
    sim.n_grips += 1;
    let verdict = sim.drive(1500, &goal(-0.8, -0.4, 0.0));
    assert!(verdict.has_arrived, "{verdict:?}");
}

#[test]
fn space_that_nothing_has_seen_is_entered_only_if_the_rig_permits_it() {
    let mut sim = Sim::new(config());
    // Nothing around the base has ever been seen.
    sim.room.seen_m.set(-1.0);
    let verdict = sim.drive(100, &velocity(0.3, 0.0, 0.0));
    assert!(clearance_of(&verdict).is_some(), "{verdict:?}");
    assert!((sim.pose.x_m - START.x_m).abs() < 0.02, "{:?}", sim.pose);
    let mut clearance = BaseClearanceConfig::new(footprint());
    clearance.is_unseen_free = true;
    let mut sim = Sim::new(BaseSteeringConfig {
        clearance: Some(clearance),
        ..BaseSteeringConfig::new(LIMITS)
    });
    sim.room.seen_m.set(-1.0);
    sim.drive(100, &velocity(0.3, 0.0, 0.0));
    assert!(sim.pose.x_m > START.x_m + 0.2, "{:?}", sim.pose);
}

#[test]
fn space_that_was_not_seen_for_long_is_entered_slowly() {
    let mut sim = Sim::new(config());
    let fresh = sim.drive(50, &velocity(0.3, 0.0, 0.0));
    assert_eq!(clearance_of(&fresh), None);
    sim.room.seen_at.set(sim.now.plus_secs(-60.0));
    sim.send(Some(1), velocity(0.3, 0.0, 0.0));
    let verdict = sim.cycle();
    let (effect, reason) = clearance_of(&verdict).expect("a limit");
    assert_eq!(effect, Effect::Slowed(0.25));
    assert!(matches!(reason, Reason::LongUnseen { .. }), "{reason}");
}

#[test]
fn something_that_appears_before_the_base_makes_it_brake() {
    let mut sim = Sim::new(config());
    sim.drive(80, &velocity(0.5, 0.0, 0.0));
    assert!(sim.follower.velocity().forward_m_s > 0.4);
    // Everything beyond the corners of the base is unknown from now on.
    sim.room.seen_m.set(HALF_WIDTH_M + 0.001);
    let verdict = sim.drive(1, &velocity(0.5, 0.3, 0.0));
    assert_ne!(clearance_of(&verdict), None, "{verdict:?}");
}

#[test]
fn ways_are_recorded_and_replay_bit_for_bit_without_the_scene() {
    let mut sim = Sim::new(config());
    let setup = serde_json::to_string(&sim.steering.setup(String::new())).unwrap();
    sim.steering.take_record();
    sim.drive(400, &velocity(0.5, 0.1, 0.2));
    sim.n_grips += 1;
    sim.drive(200, &goal(0.0, 0.0, 1.0));
    let (entries, n_dropped) = sim.steering.take_record();
    assert_eq!(n_dropped, 0);
    let setup: Setup = serde_json::from_str(&setup).unwrap();
    let mut replayed = setup.build().unwrap();
    for entry in &entries {
        let line = serde_json::to_string(entry).unwrap();
        replayed
            .replay(&serde_json::from_str(&line).unwrap())
            .unwrap();
    }
    assert_eq!(replayed.state(), sim.steering.state());
}

#[test]
fn footprints_enclose_the_robot_and_reject_what_has_no_area() {
    let circle = Footprint::circle(0.3, [0.0, 0.5]).unwrap();
    for ix in 0..50 {
        let (sin, cos) = (0.1257 * f64::from(ix)).sin_cos();
        assert!(circle.depth_m([0.299 * cos, 0.299 * sin]) > 0.0);
        assert!(circle.depth_m([0.32 * cos, 0.32 * sin]) < 0.0);
    }
    let (points, radius_m) = circle.wall_points();
    let is_on_wall = |point: &[f64; 3]| circle.depth_m([point[0], point[1]]).abs() < 1e-9;
    assert!(points.iter().all(is_on_wall) && radius_m < 0.1);
    assert!(Footprint::of_points(&[[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], [0.0, 1.0]).is_err());
    assert!(Footprint::circle(0.3, [0.5, 0.5]).is_err());
    assert!(Footprint::circle(f64::NAN, [0.0, 0.5]).is_err());
    assert!(Footprint::circle(9.0, [0.0, 0.5]).is_err());
    // The capsules for the map contain the whole footprint.
    let square = footprint();
    let capsules = square.capsules();
    let is_covered = |x: f64, y: f64, z: f64| {
        capsules.iter().any(|capsule| {
            let [low, high] = capsule.ends;
            let along = z.clamp(low.z, high.z);
            let gap = (x - low.x).hypot(y - low.y).hypot(z - along);
            gap <= capsule.radius_m
        })
    };
    for ix in -20..=20 {
        for row in -20..=20 {
            let (x, y) = (
                HALF_LENGTH_M * f64::from(ix) / 20.0,
                HALF_WIDTH_M * f64::from(row) / 20.0,
            );
            assert!(is_covered(x, y, -0.2) && is_covered(x, y, 0.3), "{x} {y}");
        }
    }
}
