//! Decisions between an operator's hand and the setpoints of an arm.
//!
//! Each link of the chain can only slow the arm down or refuse, and gives its reason ([`Reason`])
//! in words and, if there is one, with its place:
//!
//! 1. *lease*: one operator at a time may move the arm; the lease is handed over explicitly, and
//!    expires;
//! 2. *clutch*: the arm follows while a dead-man switch is held. Every grip starts where the tip
//!    is. A device that was silent must grip again, and after a stop, an operator must permit
//!    motion;
//! 3. *limits*: speed of the tip, of all parts and of the joints, workspace, ranges;
//! 4. *self-collision*: distance between parts of the robot;
//! 5. *clearance*: distance from the scene, with the age of what is known about it. What was never
//!    seen counts as occupied.
//!
//! The result ([`Output`]) is a target that expires, or the order to brake. The arm's thread turns
//! it into setpoints with [`Follower`] (see [`SteeringPort`](drivers::motion::SteeringPort)), which brakes when targets expire, whatever happens to the
//! rest of the program. Acceleration and jerk are limited there, by the generator of
//! [`drivers::motion`].
//!
//! A base has links of its own after the same lease and the same dead-man switch
//! ([`Steering::of_base`]): posture of the arm on it, limits, area and goals on the floor, and its
//! clearance. A robot with both ([`Steering::with_base`]) has one operator, and each grip moves
//! either its arm or its base. The base moves only while the arm is stowed, and the arm is slower
//! while the base moves.
//!
//! Nothing here has a clock, a thread or a connection: every function takes the time. The same
//! calls give the same decisions, bit for bit, so [`Steering::take_record`] gives records that
//! [`Steering::replay`] repeats.
//!
//! ```
//! use drivers::motion::MotionLimits;
//! use kinematics::urdf::Robot as Urdf;
//! use kinematics::{Chain, Stamp};
//! use std::time::Duration;
//! use steering::*;
//!
//! let urdf = Urdf::parse(include_str!("../../../rigs/robots/panda.urdf"))?;
//! let chain = Chain::new(&urdf, "panda_link0", "panda_link8")?;
//! let body = Body::new(&urdf, &chain, &|_| None)?;
//! let joints: Vec<MotionLimits> =
//!     chain.limits().iter().map(|joint| MotionLimits::new(joint, 1.0, 0.5, 0.1)).collect();
//! let robot = Robot {
//!     inverse: Box::new(NearestPosture::new(chain.clone())),
//!     chain,
//!     body,
//!     joints: &joints,
//!     free_posture: None,
//! };
//! let mut steering = Steering::new(SteeringConfig::default(), robot)?;
//! let start = [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];
//! let period = Duration::from_millis(1);
//! let mut follower = Follower::new(&joints, &brake_limits(&joints, 2.0), &start, period)?;
//! let scene = AnalyticScene { solids: vec![], seen_at: Stamp(0), seen_radius_m: 3.0 };
//!
//! let (operator, device) = (Operator(1), Device(1));
//! steering.handle(Stamp(0), &Request::TakeLease(operator))?;
//! let mut now = Stamp(0);
//! for cycle in 0..500_u32 {
//!     now += period;
//!     if cycle % 10 == 0 {
//!         // The switch is closed after the first sample. The hand then moves down.
//!         let grip = (cycle > 0).then_some(1);
//!         let base_from_hand = [0.0, 0.0, -1e-4 * f64::from(cycle), 0.0, 0.0, 0.0, 1.0];
//!         let intent = Intent::Hand { base_from_hand };
//!         let sequence = u64::from(cycle);
//!         let (captured_at, received_at) = (now, now);
//!         let command =
//!             Command { operator, device, sequence, captured_at, received_at, grip, intent };
//!         steering.handle(now, &Request::Command(command))?;
//!     }
//!     let arm = ArmState {
//!         reported_at: now,
//!         position: follower.setpoint().position.clone(),
//!         is_at_rest: follower.is_at_rest(),
//!         braked_motion: follower.braked_motion(),
//!         stopped: None,
//!     };
//!     let verdict = steering.cycle(now, &arm, &scene);
//!     follower.obey(now, &verdict.output)?;
//!     follower.step(now)?;
//! }
//! assert!(follower.setpoint().position[3] != start[3], "the arm has followed the hand");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod analytic_scene;
mod arm_chain;
mod authority;
mod base_area;
mod base_chain;
mod base_clearance;
mod base_footprint;
mod base_goal;
mod base_verdict;
mod body;
mod capsule;
mod check;
mod clearance;
mod clutch;
mod error;
mod fit;
mod inverse;
mod lease;
mod limits;
mod ramp;
mod reason;
mod record;
mod request;
mod self_collision;
mod steering;
mod stowed;
#[cfg(test)]
mod tests;
mod verdict;

pub use analytic_scene::{AnalyticScene, Solid};
pub use arm_chain::{Robot, SteeringConfig};
pub use authority::Authority;
pub use base_chain::BaseSteeringConfig;
pub use base_clearance::{BaseClearanceConfig, Room};
pub use base_footprint::Footprint;
pub use base_verdict::{BaseSituation, BaseVerdict, FloorPose, SeenPose, SeenPosture};
pub use body::Body;
pub use capsule::{Capsule, Gap};
pub use clearance::{Clearance, ClearanceConfig, ClearancePoints, Restriction, Seen};
pub use clutch::ClutchConfig;
pub use error::Error;
pub use inverse::{InverseKinematics, NearestPosture};
pub use lease::LeaseConfig;
pub use limits::LimitConfig;
pub use reason::{Effect, Limit, Link, Reason};
pub use record::{ArmCycle, BaseCycle, Difference, Entry};
pub use request::{Command, Device, Intent, Operator, Request};
pub use self_collision::{SelfCollision, SelfCollisionConfig};
pub use steering::Steering;
pub use steering::setup::{ArmSetup, Setup};
pub use steering::state::State;
pub use stowed::Stowed;
pub use verdict::{Decision, Situation, Verdict};

/// What passes between the chain and the arm's thread.
pub use drivers::motion::{ArmState, Follower, NotFollowed, Output, Target, brake_limits};
