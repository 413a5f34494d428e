//! A base that an operator drives, with a simulated clock: lease, dead-man switch, area, goals, and
//! the arm on it.

use crate::{
    AnalyticScene, BaseSituation, BaseSteeringConfig, BaseVerdict, Clearance, Command, Device,
    Entry, FloorPose, Intent, Operator, Reason, Request, SeenPose, SeenPosture, Setup, Situation,
    Steering, Stowed,
};
use drivers::base_motion::{BaseFollower, BaseLimits, BaseOutput, BaseState, BaseVelocity};
use kinematics::Stamp;
use numbers::random::Random;
use std::collections::VecDeque;

const ANA: Operator = Operator(1);
const BEN: Operator = Operator(2);
const PAD: Device = Device(10);
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
/// Rounding of sums.
const ROUNDING: f64 = 1e-9;

/// A chain and a base that has the velocities of its follower, and whose pose is reported late.
struct Sim {
    steering: Steering,
    scene: Box<dyn Clearance>,
    follower: BaseFollower,
    pose: FloorPose,
    poses: VecDeque<SeenPose>,
    arm: Option<Vec<f64>>,
    fault: Option<String>,
    is_silent: bool,
    reported_at: Stamp,
    now: Stamp,
    sequence: u64,
}

impl Sim {
    fn new(config: BaseSteeringConfig) -> Self {
        Self {
            follower: BaseFollower::new(config.limits).unwrap(),
            steering: Steering::of_base(config).unwrap(),
            scene: Box::new(AnalyticScene {
                solids: Vec::new(),
                seen_at: Stamp(0),
                seen_radius_m: 10.0,
            }),
            pose: FloorPose {
                x_m: 0.0,
                y_m: 0.0,
                yaw_rad: 0.0,
            },
            poses: VecDeque::new(),
            arm: None,
            fault: None,
            is_silent: false,
            reported_at: Stamp(0),
            now: Stamp(1_000_000_000),
            sequence: 0,
        }
    }

    /// Ana has control, and her pad was seen with an open switch.
    fn ready(config: BaseSteeringConfig) -> Self {
        let mut sim = Self::new(config);
        sim.request(Request::TakeLease(ANA)).unwrap();
        sim.send(None, velocity(0.0, 0.0, 0.0)).unwrap();
        sim.cycle();
        sim
    }

    fn request(&mut self, request: Request) -> Result<(), Reason> {
        self.steering.handle(self.now, &request)
    }

    fn command(&mut self, grip: Option<u64>, intent: Intent) -> Command {
        self.sequence += 1;
        Command {
            operator: ANA,
            device: PAD,
            sequence: self.sequence,
            captured_at: self.now,
            received_at: self.now,
            grip,
            intent,
        }
    }

    fn send(&mut self, grip: Option<u64>, intent: Intent) -> Result<(), Reason> {
        let command = self.command(grip, intent);
        self.request(Request::Command(command))
    }

    /// One cycle of the chain and of the base.
    fn cycle(&mut self) -> BaseVerdict {
        self.now = self.now.plus_secs(CYCLE_SECS);
        if !self.is_silent {
            self.reported_at = self.now;
        }
        let situation = BaseSituation {
            base: BaseState {
                reported_at: self.reported_at,
                velocity: self.follower.velocity(),
                is_at_rest: self.follower.is_at_rest(),
                braked_motion: self.follower.braked_motion(),
                fault: self.fault.clone(),
                refusal: None,
            },
            pose: self.poses.front().copied(),
            arm: self.arm.clone().map(|position| SeenPosture {
                at: self.now,
                position,
            }),
        };
        let situation = Situation {
            arm: None,
            base: Some(situation),
        };
        let decision = self
            .steering
            .decide(self.now, &situation, self.scene.as_ref());
        let verdict = decision.base.unwrap();
        match &verdict.output {
            BaseOutput::Drive(target) => self.follower.follow(self.now, target).unwrap(),
            BaseOutput::Brake => self
                .follower
                .brake(self.follower.braked_motion().max(self.n())),
        }
        self.step_base();
        verdict
    }

    /// Number of the newest motion.
    fn n(&self) -> u64 {
        let entries = serde_json::to_value(self.steering.state()).unwrap();
        entries["base"]["n_motions"].as_u64().unwrap()
    }

    /// One cycle of the base alone, as if the chain was stuck.
    fn step_base(&mut self) {
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
    }

    fn drive(&mut self, grip: Option<u64>, intent: Intent) -> BaseVerdict {
        self.send(grip, intent).unwrap();
        self.cycle()
    }
}

fn config() -> BaseSteeringConfig {
    BaseSteeringConfig::new(LIMITS)
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

fn is_braking(verdict: &BaseVerdict) -> bool {
    verdict.output == BaseOutput::Brake
}

fn words(verdict: &BaseVerdict) -> String {
    let limits: Vec<String> = verdict.limits.iter().map(ToString::to_string).collect();
    limits.join("; ")
}

#[test]
fn a_base_follows_the_held_switch_and_brakes_on_release() {
    let mut sim = Sim::ready(config());
    for _ in 0..100 {
        sim.drive(Some(1), velocity(0.3, 0.0, 0.0));
    }
    assert_eq!(sim.follower.velocity().forward_m_s, 0.3);
    let verdict = sim.drive(None, velocity(0.3, 0.0, 0.0));
    assert_eq!(words(&verdict), "braking: the dead-man switch is open");
    // 0.3 m/s at 0.8 m/s² take 19 cycles.
    for _ in 0..19 {
        sim.cycle();
    }
    assert!(sim.follower.is_at_rest());
    // The same grip does not move the base again, and a new one does.
    assert!(sim.send(Some(1), velocity(0.3, 0.0, 0.0)).is_err());
    assert!(is_braking(&sim.cycle()));
    let verdict = sim.drive(Some(2), velocity(0.3, 0.0, 0.0));
    assert!(!is_braking(&verdict), "{}", words(&verdict));
}

#[test]
fn silence_of_the_device_brakes_the_base_and_it_must_grip_again() {
    let mut sim = Sim::ready(config());
    for _ in 0..50 {
        sim.drive(Some(1), velocity(0.3, 0.0, 0.0));
    }
    let mut n_cycles = 0;
    let verdict = loop {
        let verdict = sim.cycle();
        n_cycles += 1;
        if is_braking(&verdict) {
            break verdict;
        }
    };
    // 120 ms, and the cycle in which they have passed.
    assert_eq!(n_cycles, 6);
    assert!(words(&verdict).contains("grip again"), "{verdict:?}");
    assert!(sim.send(Some(1), velocity(0.3, 0.0, 0.0)).is_err());
}

#[test]
fn a_blocked_chain_brakes_the_base_when_its_target_expires() {
    let mut sim = Sim::ready(config());
    for _ in 0..50 {
        sim.drive(Some(1), velocity(0.3, 0.0, 0.0));
    }
    let mut n_cycles = 0;
    while sim.follower.velocity().forward_m_s == 0.3 {
        sim.now = sim.now.plus_secs(CYCLE_SECS);
        sim.step_base();
        n_cycles += 1;
        assert!(n_cycles <= 6, "the target does not expire");
    }
    let verdict = sim.drive(Some(1), velocity(0.3, 0.0, 0.0));
    assert!(
        words(&verdict).contains("its target expired"),
        "{verdict:?}"
    );
}

#[test]
fn everybody_stops_the_base_and_only_the_holder_permits_motion_again() {
    let mut sim = Sim::ready(config());
    sim.drive(Some(1), velocity(0.3, 0.0, 0.0));
    sim.request(Request::Stop { by: Some(BEN) }).unwrap();
    let verdict = sim.cycle();
    assert!(
        words(&verdict).contains("stopped by operator 2"),
        "{verdict:?}"
    );
    assert!(sim.send(Some(2), velocity(0.3, 0.0, 0.0)).is_err());
    let rearm = |operator, stop| Request::Rearm { operator, stop };
    assert!(sim.request(rearm(BEN, 1)).is_err());
    assert!(sim.request(rearm(ANA, 0)).is_err(), "an older stop");
    sim.request(rearm(ANA, 1)).unwrap();
    let held = sim.send(Some(2), velocity(0.3, 0.0, 0.0));
    assert!(held.is_err(), "closed during the stop: {held:?}");
    let verdict = sim.drive(Some(3), velocity(0.3, 0.0, 0.0));
    assert!(!is_braking(&verdict), "{}", words(&verdict));
}

#[test]
fn control_cannot_be_stolen_and_commands_of_an_arm_are_refused() {
    let mut sim = Sim::ready(config());
    let mut command = sim.command(Some(1), velocity(0.3, 0.0, 0.0));
    command.operator = BEN;
    let refusal = sim.request(Request::Command(command)).unwrap_err();
    assert!(matches!(refusal, Reason::LeaseHeld { holder: ANA, .. }));
    let arm = Intent::JointVelocity { velocity: vec![] };
    assert_eq!(sim.send(Some(1), arm), Err(Reason::OnlyBase));
    let not_finite = sim.send(Some(1), velocity(f64::NAN, 0.0, 0.0));
    assert!(matches!(not_finite, Err(Reason::NotFinite { .. })));
}

#[test]
fn a_silent_base_brakes_and_a_fault_stops_until_motion_is_permitted() {
    let mut sim = Sim::ready(config());
    sim.drive(Some(1), velocity(0.1, 0.0, 0.0));
    sim.is_silent = true;
    let mut last = sim.cycle();
    for _ in 0..20 {
        let _ = sim.send(Some(1), velocity(0.1, 0.0, 0.0));
        last = sim.cycle();
    }
    assert!(words(&last).contains("has reported no state"), "{last:?}");
    sim.is_silent = false;
    sim.fault = Some("bumper".to_owned());
    assert!(words(&sim.cycle()).contains("bumper"));
    sim.fault = None;
    assert!(words(&sim.cycle()).contains("bumper"), "the stop lasts");
    sim.request(Request::Rearm {
        operator: ANA,
        stop: 1,
    })
    .unwrap();
    assert!(!is_braking(&sim.drive(Some(9), velocity(0.1, 0.0, 0.0))));
}

#[test]
fn the_base_moves_only_while_the_arm_on_it_is_stowed() {
    let mut sim = Sim::ready(BaseSteeringConfig {
        stowed: Some(Stowed {
            joints: vec!["shoulder".to_owned(), "elbow".to_owned()],
            position: vec![0.0, -1.5],
            tolerance: 0.1,
        }),
        ..config()
    });
    let verdict = sim.drive(Some(1), velocity(0.1, 0.0, 0.0));
    assert!(words(&verdict).contains("posture of the arm is not known"));
    sim.arm = Some(vec![0.05, -1.2]);
    let verdict = sim.drive(Some(2), velocity(0.1, 0.0, 0.0));
    assert_eq!(
        words(&verdict),
        "braking: joint elbow is 0.30 from its stowed position: stow the arm before the base moves"
    );
    sim.arm = Some(vec![0.05, -1.45]);
    assert!(!is_braking(&sim.drive(Some(3), velocity(0.1, 0.0, 0.0))));
    sim.arm = Some(vec![f64::NAN, -1.45]);
    assert!(is_braking(&sim.drive(Some(3), velocity(0.1, 0.0, 0.0))));
}

#[test]
fn the_base_never_leaves_its_area_and_returns_from_its_edge() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let mut sim = Sim::ready(BaseSteeringConfig {
            area_m: Some([-1.0, -0.5, 1.0, 0.5]),
            ..config()
        });
        for _ in 0..POSE_DELAY {
            sim.cycle();
        }
        let mut n_slowed = 0;
        let mut wanted = [0.0; 3];
        for step in 0..3000 {
            if step % 150 == 0 {
                wanted = std::array::from_fn(|_| random.uniform(-1.0, 1.0));
            }
            let [x, y, yaw] = wanted;
            let verdict = sim.drive(Some(1), velocity(x, y, yaw));
            assert!(!is_braking(&verdict), "{}", words(&verdict));
            n_slowed += u32::from(words(&verdict).contains("edge of its area"));
            let FloorPose { x_m, y_m, .. } = sim.pose;
            assert!(x_m.abs() <= 1.0 && y_m.abs() <= 0.5, "{x_m}, {y_m}");
        }
        assert!(n_slowed > 50, "{n_slowed}");
        for _ in 0..2000 {
            sim.drive(Some(1), goal(0.0, 0.0, 0.0));
        }
        assert!(sim.pose.x_m.abs() < 0.05, "it does not return");
    }
}

#[test]
fn goals_are_reached_and_kept_by_bases_that_can_and_cannot_move_sideways() {
    for max_left_m_s in [0.3, 0.0] {
        let mut random = Random::new(5);
        let mut sim = Sim::ready(BaseSteeringConfig::new(BaseLimits {
            max_left_m_s,
            ..LIMITS
        }));
        for _ in 0..POSE_DELAY {
            sim.cycle();
        }
        for _ in 0..100 {
            let wanted = [
                random.uniform(-2.0, 2.0),
                random.uniform(-2.0, 2.0),
                random.uniform(-4.0, 4.0),
            ];
            let [x, y, yaw] = wanted;
            let mut n_cycles = 0;
            while !sim.drive(Some(1), goal(x, y, yaw)).has_arrived {
                n_cycles += 1;
                assert!(n_cycles < 3000, "{wanted:?} is not reached: {:?}", sim.pose);
            }
            for _ in 0..100 {
                sim.drive(Some(1), goal(x, y, yaw));
            }
            let off_m = (sim.pose.x_m - x).hypot(sim.pose.y_m - y);
            let off_rad = crate::base_goal::wrapped(sim.pose.yaw_rad - yaw).abs();
            assert!(off_m < 0.05 && off_rad < 0.05, "{off_m} m, {off_rad} rad");
            assert!(sim.follower.velocity().is_rest());
        }
    }
}

#[test]
fn goals_outside_the_area_and_goals_without_a_pose_are_refused() {
    let mut sim = Sim::ready(BaseSteeringConfig {
        area_m: Some([-1.0, -1.0, 1.0, 1.0]),
        ..config()
    });
    let verdict = sim.drive(Some(1), goal(2.0, 0.0, 0.0));
    assert!(words(&verdict).contains("goal is outside"), "{verdict:?}");
    assert_eq!(verdict.limits[0].reason.place(), Some([2.0, 0.0, 0.0]));
    for _ in 0..100 {
        sim.drive(Some(1), goal(2.0, 0.0, 0.0));
    }
    assert_eq!(sim.pose.x_m, 0.0);
    let mut sim = Sim::ready(config());
    sim.poses.clear();
    let verdict = sim.drive(Some(1), goal(0.5, 0.0, 0.0));
    assert!(words(&verdict).contains("pose of the base"), "{verdict:?}");
    // Velocities need no pose where there is no area.
    sim.poses.clear();
    assert!(!is_braking(&sim.drive(Some(2), velocity(0.1, 0.0, 0.0))));
}

#[test]
fn random_events_break_no_limit_and_replay_bit_for_bit() {
    let mut random = Random::new(29);
    let mut sim = Sim::ready(BaseSteeringConfig {
        area_m: Some([-1.0, -1.0, 1.0, 1.0]),
        ..config()
    });
    let setup = serde_json::to_string(&sim.steering.setup(String::new())).unwrap();
    let setup: Setup = serde_json::from_str(&setup).unwrap();
    sim.steering.take_record();
    let mut entries = Vec::new();
    let mut grip = 1;
    let mut n_moving = 0;
    for _ in 0..2500 {
        let intent = match random.below(20) {
            0 => velocity(f64::NAN, 0.0, f64::INFINITY),
            1 => velocity(1e300, -1e300, 3.0),
            2..=8 => goal(random.uniform(-1.2, 1.2), 0.3, random.uniform(-9.0, 9.0)),
            _ => velocity(random.uniform(-1.0, 1.0), 0.2, 0.4),
        };
        let held = (random.below(30) > 0).then_some(grip);
        let _ = sim.send(held, intent);
        match random.below(200) {
            0 => sim.request(Request::Stop { by: Some(BEN) }).unwrap(),
            1 => sim.now = sim.now.plus_secs(0.2),
            2 => sim.now = sim.now.plus_secs(-0.5),
            3 => {
                let _ = sim.request(Request::TakeLease(ANA));
            }
            _ => {}
        }
        let before = sim.follower.velocity();
        if is_braking(&sim.cycle()) {
            grip += 1;
            let _ = sim.request(Request::TakeLease(ANA));
            let stop = sim.steering.stop_number();
            let _ = sim.request(Request::Rearm {
                operator: ANA,
                stop,
            });
        }
        let after = sim.follower.velocity();
        n_moving += u32::from(after != BaseVelocity::ZERO);
        let change =
            (after.forward_m_s - before.forward_m_s).hypot(after.left_m_s - before.left_m_s);
        // The longest step of the follower is 0.1 s.
        assert!(change <= LIMITS.brake_m_s2 * 0.1 + ROUNDING, "{change}");
        let (new, n_dropped) = sim.steering.take_record();
        assert_eq!(n_dropped, 0);
        entries.extend(new);
    }
    assert!(n_moving > 500, "{n_moving}");
    let mut replayed = setup.build().unwrap();
    for entry in &entries {
        let line = serde_json::to_string(entry).unwrap();
        let entry: Entry = serde_json::from_str(&line).unwrap();
        replayed.replay(&entry).unwrap();
    }
    assert_eq!(replayed.state(), sim.steering.state());
    // A target that differs in its last bit is found.
    let mut fresh = setup.build().unwrap();
    let changed = entries.iter_mut().find_map(|entry| match entry {
        Entry::Cycle { base, .. } => match &mut base.as_mut()?.verdict.output {
            BaseOutput::Drive(target) if target.velocity.forward_m_s != 0.0 => {
                Some(&mut target.velocity.forward_m_s)
            }
            _ => None,
        },
        Entry::Request { .. } => None,
    });
    let changed = changed.expect("a velocity");
    *changed = f64::from_bits(changed.to_bits() ^ 1);
    assert!(entries.iter().any(|entry| fresh.replay(entry).is_err()));
}

#[test]
fn configurations_that_cannot_work_are_refused() {
    let no_brake = BaseLimits {
        brake_m_s2: 0.1,
        ..LIMITS
    };
    for (config, expected) in [
        (BaseSteeringConfig::new(no_brake), "brake_m_s2"),
        (
            BaseSteeringConfig {
                area_m: Some([0.0, 0.0, 0.0, 1.0]),
                ..config()
            },
            "largest x",
        ),
        (
            BaseSteeringConfig {
                stowed: Some(Stowed {
                    joints: vec!["a".to_owned()],
                    position: vec![],
                    tolerance: 0.1,
                }),
                ..config()
            },
            "stowed",
        ),
    ] {
        let error = Steering::of_base(config).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}
