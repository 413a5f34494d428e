//! A base with an arm, with a simulated clock: one operator, one dead-man switch, and the rules
//! between both parts.

use super::{
    ANA, BEN, BRAKE_FACTOR, CYCLE, PAD, START, ageless, free_scene, hand, joint_limits, panda,
};
use crate::{
    AnalyticScene, ArmState, BaseSituation, BaseSteeringConfig, Body, Command, Decision, Effect,
    Entry, Follower, Intent, Link, Output, Reason, Request, Robot, SeenPose, SeenPosture, Setup,
    Situation, Steering, Stowed, brake_limits,
};
use drivers::base_motion::{BaseFollower, BaseLimits, BaseOutput, BaseState};
use drivers::motion::MotionLimits;
use kinematics::Stamp;
use numbers::random::Random;

const LIMITS: BaseLimits = BaseLimits {
    max_forward_m_s: 0.5,
    max_left_m_s: 0.3,
    max_yaw_rad_s: 0.8,
    acceleration_m_s2: 0.4,
    yaw_acceleration_rad_s2: 0.8,
    brake_m_s2: 0.8,
    brake_yaw_rad_s2: 1.6,
};
const TOLERANCE_RAD: f64 = 0.1;

/// A robot whose parts follow the decisions exactly.
struct Mobile {
    steering: Steering,
    scene: AnalyticScene,
    arm: Follower,
    base: BaseFollower,
    base_fault: Option<String>,
    arm_fault: Option<String>,
    is_arm_silent: bool,
    now: Stamp,
    sequence: u64,
}

impl Mobile {
    /// Ana has control, and her pad was seen with an open switch. The arm is stowed.
    fn ready() -> Self {
        let (_, chain) = panda();
        let limits = joint_limits(&chain);
        let brake = brake_limits(&limits, BRAKE_FACTOR);
        let mut mobile = Self {
            steering: steering(&limits),
            scene: free_scene(),
            arm: Follower::new(&limits, &brake, &START, CYCLE).unwrap(),
            base: BaseFollower::new(LIMITS).unwrap(),
            base_fault: None,
            arm_fault: None,
            is_arm_silent: false,
            now: Stamp(1_000_000_000),
            sequence: 0,
        };
        mobile.request(Request::TakeLease(ANA)).unwrap();
        mobile.send(None, drive(0.0)).unwrap();
        mobile.cycle();
        mobile
    }

    fn request(&mut self, request: Request) -> Result<(), Reason> {
        self.steering.handle(self.now, &request)
    }

    fn send(&mut self, grip: Option<u64>, intent: Intent) -> Result<(), Reason> {
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
        self.request(Request::Command(command))
    }

    fn situation(&self) -> Situation {
        let position = self.arm.setpoint().position.clone();
        let reported_at = if self.is_arm_silent {
            Stamp(0)
        } else {
            self.now
        };
        Situation {
            arm: Some(ArmState {
                reported_at,
                position: position.clone(),
                is_at_rest: self.arm.is_at_rest(),
                braked_motion: self.arm.braked_motion(),
                stopped: self.arm_fault.clone(),
            }),
            base: Some(BaseSituation {
                base: BaseState {
                    reported_at: self.now,
                    velocity: self.base.velocity(),
                    is_at_rest: self.base.is_at_rest(),
                    braked_motion: self.base.braked_motion(),
                    fault: self.base_fault.clone(),
                    refusal: None,
                },
                pose: Some(SeenPose {
                    at: self.now,
                    pose: crate::FloorPose {
                        x_m: 0.0,
                        y_m: 0.0,
                        yaw_rad: 0.0,
                    },
                    z_m: 0.5,
                }),
                arm: Some(SeenPosture {
                    at: reported_at,
                    position,
                }),
            }),
        }
    }

    /// One cycle of the chain and of both parts.
    fn cycle(&mut self) -> Decision {
        self.now += CYCLE;
        self.scene.seen_at = self.now;
        let situation = self.situation();
        let decision = self.steering.decide(self.now, &situation, &self.scene);
        let arm = decision.arm.as_ref().unwrap();
        let base = decision.base.as_ref().unwrap();
        assert!(
            arm.target().is_none() || base.target().is_none(),
            "a grip moves one part"
        );
        self.arm.obey(self.now, &arm.output).unwrap();
        self.arm.step(self.now).unwrap();
        match &base.output {
            BaseOutput::Drive(target) => self.base.follow(self.now, target).unwrap(),
            BaseOutput::Brake => self.base.brake(u64::MAX / 2),
        }
        self.base.step(self.now);
        decision
    }

    fn run(&mut self, grip: u64, n_cycles: u32, intent: &Intent) -> Decision {
        let mut last = Decision::default();
        for _ in 0..n_cycles {
            let _ = self.send(Some(grip), intent.clone());
            last = self.cycle();
        }
        last
    }
}

fn config() -> BaseSteeringConfig {
    let (_, chain) = panda();
    BaseSteeringConfig {
        stowed: Some(Stowed {
            joints: chain.joint_names().to_vec(),
            position: START.to_vec(),
            tolerance: TOLERANCE_RAD,
        }),
        ..BaseSteeringConfig::new(LIMITS)
    }
}

fn steering(joints: &[MotionLimits]) -> Steering {
    let (urdf, chain) = panda();
    let body = Body::new(&urdf, &chain, &|_| None).unwrap();
    let robot = Robot {
        inverse: Box::new(crate::NearestPosture::new(chain.clone())),
        joints,
        chain,
        body,
        free_posture: Some(&START),
    };
    let arm = Steering::new(ageless(), robot).unwrap();
    arm.with_base(config()).unwrap()
}

fn drive(forward: f64) -> Intent {
    Intent::BaseVelocity {
        velocity: [forward, 0.0, 0.0],
    }
}

fn joint_speed(velocity: f64) -> Intent {
    let mut velocities = vec![0.0; 7];
    velocities[0] = velocity;
    Intent::JointVelocity {
        velocity: velocities,
    }
}

fn arm_words(decision: &Decision) -> String {
    let limits = decision.arm.iter().flat_map(|verdict| &verdict.limits);
    let words: Vec<String> = limits.map(ToString::to_string).collect();
    words.join("; ")
}

fn base_words(decision: &Decision) -> String {
    let limits = decision.base.iter().flat_map(|verdict| &verdict.limits);
    let words: Vec<String> = limits.map(ToString::to_string).collect();
    words.join("; ")
}

#[test]
fn each_grip_moves_one_part_and_never_the_other() {
    let mut mobile = Mobile::ready();
    let decision = mobile.run(1, 20, &drive(0.2));
    assert!(decision.base.as_ref().unwrap().target().is_some());
    assert!(arm_words(&decision).contains("the base is being moved"));
    // The same grip cannot move the arm, and is used up.
    let refused = mobile.send(Some(1), joint_speed(0.2)).unwrap_err();
    assert_eq!(refused, Reason::OtherPart);
    let decision = mobile.cycle();
    assert_eq!(decision.arm.as_ref().unwrap().output, Output::Brake);
    assert_eq!(decision.base.as_ref().unwrap().output, BaseOutput::Brake);
    mobile.send(Some(1), drive(0.2)).unwrap_err();
    // A new grip can.
    let decision = mobile.run(2, 20, &joint_speed(0.2));
    assert!(decision.arm.as_ref().unwrap().target().is_some());
    assert!(base_words(&decision).contains("the arm is being moved"));
}

#[test]
fn the_arm_is_slower_until_the_base_is_at_rest() {
    let mut mobile = Mobile::ready();
    mobile.run(1, 150, &drive(0.5));
    assert!(!mobile.base.is_at_rest());
    let before = mobile.arm.setpoint().position[0];
    let decision = mobile.run(2, 2, &joint_speed(0.4));
    let limits = &decision.arm.as_ref().unwrap().limits;
    let slowed = limits
        .iter()
        .find(|limit| limit.reason == Reason::BaseMoves);
    let slowed = slowed.expect("the base still brakes");
    assert_eq!(
        (slowed.link, slowed.effect),
        (Link::Base, Effect::Slowed(0.25))
    );
    while !mobile.base.is_at_rest() {
        mobile.run(2, 1, &joint_speed(0.4));
    }
    let decision = mobile.run(2, 50, &joint_speed(0.4));
    assert!(
        !arm_words(&decision).contains("the base under"),
        "{decision:?}"
    );
    assert!(mobile.arm.setpoint().position[0] > before + 0.05);
}

#[test]
fn the_base_waits_for_the_arm_to_rest_in_its_stowed_posture() {
    let mut mobile = Mobile::ready();
    mobile.run(1, 100, &joint_speed(0.3));
    assert!((mobile.arm.setpoint().position[0] - START[0]).abs() > TOLERANCE_RAD);
    let decision = mobile.run(2, 1, &drive(0.2));
    assert!(
        base_words(&decision).contains("stow the arm"),
        "{decision:?}"
    );
    // Back to the stowed posture. While the arm still moves, the base waits without losing its grip.
    while mobile.arm.setpoint().position[0] > START[0] + 0.5 * TOLERANCE_RAD {
        mobile.run(3, 1, &joint_speed(-0.3));
    }
    assert!(!mobile.arm.is_at_rest());
    let decision = mobile.run(4, 1, &drive(0.2));
    assert!(
        base_words(&decision).contains("still braking"),
        "{decision:?}"
    );
    let decision = mobile.run(4, 100, &drive(0.2));
    assert!(
        decision.base.as_ref().unwrap().target().is_some(),
        "{decision:?}"
    );
}

#[test]
fn stops_faults_and_silence_of_either_part_stop_both() {
    let mut mobile = Mobile::ready();
    mobile.run(1, 20, &drive(0.2));
    mobile.request(Request::Stop { by: Some(BEN) }).unwrap();
    let decision = mobile.cycle();
    assert_eq!(arm_words(&decision), base_words(&decision));
    assert!(arm_words(&decision).contains("stopped by operator 2"));
    let permit = |mobile: &mut Mobile| {
        let stop = mobile.steering.stop_number();
        mobile
            .request(Request::Rearm {
                operator: ANA,
                stop,
            })
            .unwrap();
    };
    permit(&mut mobile);
    while !mobile.base.is_at_rest() {
        mobile.cycle();
    }
    // A fault of the base stops an arm that moves.
    mobile.run(2, 20, &joint_speed(0.3));
    mobile.base_fault = Some("bumper".to_owned());
    let decision = mobile.run(2, 1, &joint_speed(0.3));
    assert!(arm_words(&decision).contains("bumper"), "{decision:?}");
    mobile.base_fault = None;
    permit(&mut mobile);
    while !mobile.arm.is_at_rest() {
        mobile.cycle();
    }
    // A fault of the arm stops a base that moves, and silence of the arm ends its grip.
    mobile.run(3, 60, &joint_speed(-0.1));
    while !mobile.arm.is_at_rest() {
        mobile.cycle();
    }
    mobile.run(4, 20, &drive(0.2));
    assert!(!mobile.base.is_at_rest());
    mobile.is_arm_silent = true;
    let decision = mobile.run(4, 1, &drive(0.2));
    assert!(base_words(&decision).contains("the arm has reported no state"));
    mobile.is_arm_silent = false;
    mobile.arm_fault = Some("a motor is too hot".to_owned());
    let decision = mobile.cycle();
    assert!(base_words(&decision).contains("too hot"), "{decision:?}");
}

#[test]
fn records_of_both_parts_replay_bit_for_bit() {
    let mut mobile = Mobile::ready();
    let setup = serde_json::to_string(&mobile.steering.setup(super::PANDA.to_owned())).unwrap();
    mobile.steering.take_record();
    let mut random = Random::new(42);
    let mut grip = 1;
    let mut entries = Vec::new();
    let (mut n_arm, mut n_base) = (0, 0);
    for step in 0..1500 {
        if step % 60 == 0 {
            grip += 1;
        }
        let intent = match (grip / 2 % 2, random.below(25)) {
            (_, 0) => drive(f64::NAN),
            (0, _) => drive(random.uniform(-0.3, 0.3)),
            (_, 1) => hand(0.0, 0.0, -0.01),
            (_, _) => joint_speed(random.uniform(-0.1, 0.1)),
        };
        let _ = mobile.send((random.below(40) > 0).then_some(grip), intent);
        if random.below(300) == 0 {
            mobile.request(Request::Stop { by: Some(BEN) }).unwrap();
            let stop = mobile.steering.stop_number();
            let _ = mobile.request(Request::Rearm {
                operator: ANA,
                stop,
            });
        }
        let decision = mobile.cycle();
        n_arm += u32::from(decision.arm.is_some_and(|it| it.target().is_some()));
        n_base += u32::from(decision.base.is_some_and(|it| it.target().is_some()));
        entries.extend(mobile.steering.take_record().0);
    }
    assert!(n_arm > 100 && n_base > 100, "{n_arm} {n_base}");
    let setup: Setup = serde_json::from_str(&setup).unwrap();
    let mut replayed = setup.build().unwrap();
    for entry in &entries {
        let line = serde_json::to_string(entry).unwrap();
        let entry: Entry = serde_json::from_str(&line).unwrap();
        replayed.replay(&entry).unwrap();
    }
    assert_eq!(replayed.state(), mobile.steering.state());
}
