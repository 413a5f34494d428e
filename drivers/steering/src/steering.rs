//! The chain of decisions: lease and clutch of the whole robot, then the links of its arm and of its
//! base.

use crate::arm_chain::{ArmChain, ArmInput, Look, Robot, SteeringConfig};
use crate::authority::Authority;
use crate::base_chain::{BaseChain, BaseInput, BaseSteeringConfig, goal_of};
use crate::base_clearance::{Room, RoomLook};
use crate::base_verdict::BaseSituation;
use crate::clearance::{Clearance, Restriction};
use crate::error::Error;
use crate::reason::{Limit, Link, Reason};
use crate::record::{ArmCycle, BaseCycle, Difference, Entry, Record, are_identical};
use crate::request::{Operator, Request};
use crate::self_collision::SelfCollision;
use crate::verdict::{Decision, Situation, Verdict};
use drivers::motion::ArmState;
use kinematics::Stamp;
use std::sync::Arc;

pub(crate) mod setup;
pub(crate) mod state;

/// Number of entries of the record that are kept if nobody takes them: a minute at 100 Hz.
const MAX_ENTRIES: usize = 6000;

/// Decides what a robot does, from the requests of operators and from what is known about the robot
/// and the scene. The robot is an arm, a base, or a base with an arm: one operator has control of
/// all of it, and each grip of a dead-man switch moves either the arm or the base.
///
/// It has no clock and no threads: every function takes the time, on one monotonic clock. The same
/// calls give the same decisions, bit for bit.
#[derive(Debug)]
pub struct Steering {
    authority: Authority,
    arm: Option<ArmChain>,
    base: Option<BaseChain>,
    record: Record,
}

/// What the links look at.
struct Looks<'a> {
    arm: &'a mut Look<'a>,
    base: &'a mut RoomLook<'a>,
}

impl Steering {
    /// Builds the chain of an arm. Nobody has control at first, and the arm must be at rest.
    ///
    /// # Errors
    /// If a value of the configuration is out of its range, or numbers of joints differ.
    pub fn new(config: SteeringConfig, robot: Robot<'_>) -> Result<Self, Error> {
        let n_joints = robot.chain.n_joints();
        Ok(Self {
            authority: Authority::new(config.lease, config.clutch, n_joints)?,
            arm: Some(ArmChain::new(config, robot)?),
            base: None,
            record: Record::new(MAX_ENTRIES),
        })
    }

    /// Builds the chain of a base. Nobody has control at first.
    ///
    /// # Errors
    /// If a value of the configuration is out of its range.
    pub fn of_base(config: BaseSteeringConfig) -> Result<Self, Error> {
        Ok(Self {
            authority: Authority::new(config.lease, config.clutch, 0)?,
            arm: None,
            base: Some(BaseChain::new(config)?),
            record: Record::new(MAX_ENTRIES),
        })
    }

    /// Adds the base of the arm.
    ///
    /// * `config`: its lease and clutch are replaced by those of the arm.
    ///
    /// # Errors
    /// If a value of the configuration is out of its range.
    pub fn with_base(self, config: BaseSteeringConfig) -> Result<Self, Error> {
        let config = match &self.arm {
            Some(arm) => BaseSteeringConfig {
                lease: arm.config.lease,
                clutch: arm.config.clutch,
                ..config
            },
            None => config,
        };
        Ok(Self {
            base: Some(BaseChain::new(config)?),
            ..self
        })
    }

    /// Who has control, and whether the robot is stopped.
    pub fn authority(&self) -> &Authority {
        &self.authority
    }

    /// Who has control, and since when.
    pub fn holder(&self) -> Option<(Operator, Stamp)> {
        self.authority.holder()
    }

    /// Time until the lease expires if its holder is silent; `None` if nobody has control.
    pub fn lease_left_secs(&self, now: Stamp) -> Option<f64> {
        self.authority.lease_left_secs(now)
    }

    /// Why the robot stays at rest until an operator permits motion, if it does.
    pub fn stop(&self) -> Option<&Reason> {
        self.authority.stop().map(|(_, reason)| reason)
    }

    /// Number of the newest stop; see [`Authority::stop_number`].
    pub fn stop_number(&self) -> u64 {
        self.authority.stop_number()
    }

    /// The goal to which the operator sends the base now: x, y, heading in the world.
    pub fn base_goal(&self) -> Option<[f64; 3]> {
        goal_of(&self.authority)
    }

    /// The pairs of parts of an arm that are checked for collisions.
    pub fn self_collision(&self) -> Option<&SelfCollision> {
        self.arm.as_ref().map(|arm| &arm.self_collision)
    }

    /// Checks a posture of the arm with the links that depend on it: limits, self-collision and
    /// clearance. It changes nothing, and says nothing about the way to the posture.
    ///
    /// * `q`: joint values in the order of the chain.
    /// * `scene`: what is known about the scene.
    ///
    /// # Errors
    /// The first limit that would refuse the posture.
    pub fn check_posture(&self, now: Stamp, q: &[f64], scene: &dyn Clearance) -> Result<(), Limit> {
        let arm = self.arm.as_ref();
        arm.map_or(Ok(()), |arm| arm.check_posture(now, q, scene))
    }

    /// Takes a request. Motion changes with the next [`Steering::decide`].
    ///
    /// # Errors
    /// Why the request was refused. A refused command may still open the clutch.
    pub fn handle(&mut self, now: Stamp, request: &Request) -> Result<(), Reason> {
        let result = self.decide_request(now, request);
        self.record.push(Entry::Request {
            at: now,
            request: request.clone(),
            refusal: result.clone().err(),
        });
        result
    }

    /// Decides what an arm without a steered base does in this cycle; see [`Steering::decide`].
    ///
    /// * `arm`: the newest state of the arm.
    pub fn cycle(&mut self, now: Stamp, arm: &ArmState, scene: &dyn Clearance) -> Verdict {
        let situation = Situation {
            arm: Some(arm.clone()),
            base: None,
        };
        let decision = self.decide(now, &situation, scene);
        decision.arm.unwrap_or_else(Verdict::braking_without_arm)
    }

    /// Decides what the robot does in this cycle. Call it at the rate of the commands, or faster.
    ///
    /// * `situation`: the newest states of all parts of the chain. A part without a state is
    ///   treated like one that is silent.
    /// * `scene`: what is known about the scene.
    pub fn decide(&mut self, now: Stamp, situation: &Situation, scene: &dyn Clearance) -> Decision {
        if let Some(report) = scene.failure().filter(|_| self.needs_scene_now()) {
            // The failure lasts: if motion is permitted, the next cycle stops the robot again.
            let stopped = self.handle(now, &Request::SceneLost { report });
            debug_assert!(stopped.is_ok(), "everybody may stop the robot");
        }
        // The closures use their own copies while the decision changes the rest.
        let points = self.arm.as_ref().map(|arm| Arc::clone(&arm.clearance));
        let clearance = self
            .base
            .as_ref()
            .and_then(|base| base.clearance().cloned());
        let (mut seen, mut rooms) = (Vec::new(), Vec::new());
        let decision = self.decide_cycle(
            now,
            situation,
            Looks {
                arm: &mut |points_in_base| {
                    let readings = scene.readings(points_in_base, now);
                    let points = points.as_ref();
                    let restrictions = points.map_or(Vec::new(), |it| it.restrictions(&readings));
                    seen.push(restrictions.clone());
                    restrictions
                },
                base: &mut |way| {
                    let mut read = |points: &[[f64; 3]]| scene.base_readings(points, now);
                    let room = clearance.as_ref().map(|it| it.room(way, &mut read));
                    let room = room.unwrap_or_default();
                    rooms.push(room);
                    room
                },
            },
        );
        let arm = situation.arm.clone().zip(decision.arm.clone());
        let base = situation.base.clone().zip(decision.base.clone());
        self.record.push(Entry::Cycle {
            at: now,
            arm: arm.map(|(state, verdict)| {
                Box::new(ArmCycle {
                    state,
                    seen,
                    verdict,
                })
            }),
            base: base.map(|(situation, verdict)| {
                Box::new(BaseCycle {
                    situation,
                    rooms,
                    verdict,
                })
            }),
        });
        decision
    }

    /// Takes the entries since the last call, and the number of older ones that were dropped
    /// because this function was called too rarely. Together with the configuration and the robot,
    /// all entries since the start make a replay.
    pub fn take_record(&mut self) -> (Vec<Entry>, u64) {
        self.record.take()
    }

    /// Repeats an entry of a record. The chain must be in the state in which the entry was made: a
    /// new chain for the first entry.
    ///
    /// # Errors
    /// If the decision differs from the recorded one.
    pub fn replay(&mut self, entry: &Entry) -> Result<(), Difference> {
        match entry {
            Entry::Request {
                at,
                request,
                refusal,
            } => {
                let replayed = self.decide_request(*at, request).err();
                if replayed == *refusal {
                    return Ok(());
                }
                Err(Difference {
                    at: *at,
                    replayed: format!("{replayed:?}"),
                    recorded: format!("{refusal:?}"),
                })
            }
            Entry::Cycle { at, arm, base } => {
                self.replay_cycle(*at, arm.as_deref(), base.as_deref())
            }
        }
    }

    fn replay_cycle(
        &mut self,
        at: Stamp,
        arm: Option<&ArmCycle>,
        base: Option<&BaseCycle>,
    ) -> Result<(), Difference> {
        let mut seen = arm.map_or(&[][..], |arm| &arm.seen).iter();
        let mut rooms = base.map_or(&[][..], |base| &base.rooms).iter();
        if let Some(chain) = &self.arm {
            let n_points = chain.clearance.n_points();
            let mut points = seen.clone().flatten();
            if let Some(other) = points.find(|it| it.point_ix >= n_points) {
                return Err(Difference {
                    at,
                    replayed: format!("with {n_points} points of the robot"),
                    recorded: format!("a distance of point {}", other.point_ix),
                });
            }
        }
        let situation = Situation {
            arm: arm.map(|arm| arm.state.clone()),
            base: base.map(|base| base.situation.clone()),
        };
        let mut next_seen =
            |_: &[[f64; 3]]| -> Vec<Restriction> { seen.next().cloned().unwrap_or_default() };
        let replayed = self.decide_cycle(
            at,
            &situation,
            Looks {
                arm: &mut next_seen,
                base: &mut |_| -> Room { rooms.next().copied().unwrap_or_default() },
            },
        );
        let recorded = Decision {
            arm: arm.map(|arm| arm.verdict.clone()),
            base: base.map(|base| base.verdict.clone()),
        };
        if are_identical(&replayed, &recorded) {
            return Ok(());
        }
        Err(Difference {
            at,
            replayed: format!("{replayed:?}"),
            recorded: format!("{recorded:?}"),
        })
    }

    /// Whether a failure of the scene must stop the robot, which is not stopped yet.
    fn needs_scene_now(&self) -> bool {
        let base = self.base.as_ref();
        let needs_scene = self.arm.is_some() || base.is_some_and(|it| it.clearance().is_some());
        needs_scene && self.authority.stop().is_none()
    }

    fn decide_request(&mut self, now: Stamp, request: &Request) -> Result<(), Reason> {
        self.authority.advance(now);
        if let Request::Command(command) = request
            && command.grip.is_some()
        {
            if command.intent.is_of_base() && self.base.is_none() {
                return Err(Reason::NoBase);
            }
            if !command.intent.is_of_base() && self.arm.is_none() {
                return Err(Reason::OnlyBase);
            }
        }
        self.authority.handle(now, request)
    }

    fn decide_cycle(&mut self, now: Stamp, situation: &Situation, looks: Looks<'_>) -> Decision {
        self.authority.advance(now);
        let permission = self.permission(now, situation);
        let moves_base = self.authority.moves_base().unwrap_or(false);
        let arm_state = situation.arm.as_ref();
        let base_state = situation.base.as_ref();
        let authority = &mut self.authority;
        let arm = self.arm.as_mut().zip(arm_state).map(|(chain, arm)| {
            if let Err(limit) = permission.clone() {
                return chain.rest(now, limit);
            }
            if moves_base {
                return chain.rest(now, (Link::Clutch, Reason::BaseHasGrip));
            }
            let is_base_moving = base_state.is_some_and(|it| !it.base.is_at_rest);
            let input = ArmInput {
                now,
                arm,
                base_scale: if is_base_moving {
                    chain.config.moving_base_frac
                } else {
                    1.0
                },
            };
            chain.decide(authority, &input, looks.arm)
        });
        let base = self
            .base
            .as_mut()
            .zip(base_state)
            .map(|(chain, situation)| {
                if let Err(limit) = permission {
                    return chain.rest(limit);
                }
                if !moves_base {
                    return chain.rest((Link::Clutch, Reason::ArmHasGrip));
                }
                let input = BaseInput {
                    now,
                    situation,
                    is_arm_at_rest: arm_state.is_none_or(|arm| arm.is_at_rest),
                };
                chain.decide(authority, &input, looks.base)
            });
        Decision { arm, base }
    }

    /// Whether lease, clutch and all parts permit a motion of the part that the grip moves. A part
    /// that reports nothing may be anywhere, so its silence ends every grip.
    fn permission(&mut self, now: Stamp, situation: &Situation) -> Result<(), (Link, Reason)> {
        let authority = &mut self.authority;
        // A part that stops may report nothing after its reason, so the reasons come first.
        if let Some((chain, arm)) = self.arm.as_mut().zip(situation.arm.as_ref()) {
            chain.note_stopped(authority, arm);
        }
        if let Some((chain, it)) = self.base.as_mut().zip(situation.base.as_ref()) {
            chain.note_fault(authority, &it.base);
        }
        if let Some(stop) = authority.stop() {
            return Err(stop.clone());
        }
        if let Some(chain) = &self.arm
            && let Some(reason) = arm_problem(chain, now, situation.arm.as_ref())
        {
            return Err(authority.brake(Link::Arm, reason));
        }
        if let Some(chain) = &self.base
            && let Some(reason) = base_problem(chain, now, situation.base.as_ref())
        {
            return Err(authority.brake(Link::Base, reason));
        }
        authority.permitted(now)
    }
}

fn arm_problem(chain: &ArmChain, now: Stamp, arm: Option<&ArmState>) -> Option<Reason> {
    match arm {
        Some(arm) => chain.problem(now, arm),
        None => Some(Reason::ArmReport {
            report: "nothing".to_owned(),
        }),
    }
}

fn base_problem(chain: &BaseChain, now: Stamp, it: Option<&BaseSituation>) -> Option<Reason> {
    match it {
        Some(it) => chain.problem(now, &it.base),
        None => Some(Reason::BaseSilent {
            silent_secs: f64::MAX,
        }),
    }
}
