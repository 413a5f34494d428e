//! Incidents in a steering log: changes of control, stops, brakes, refusals, and where the arm
//! was.

use super::line::{Line, Start};
use super::reader::LogReader;
use kinematics::{Chain, Stamp, transform};
use nalgebra::Point3;
use serde::Serialize;
use std::collections::VecDeque;
use std::mem::{Discriminant, discriminant};
use std::path::{Path, PathBuf};
use steering::{
    ArmCycle, BaseCycle, Effect, Entry, Limit, Link, Operator, Reason, Request, SeenPose,
};

/// Number of incidents that are kept, the newest ones.
const MAX_INCIDENTS: usize = 2000;
/// A limit or a refusal that comes again within this time continues the same incident.
const EPISODE_SECS: f64 = 1.0;

/// Time between two samples of the track.
const SAMPLE_SECS: f64 = 0.05;
/// Time before and after an incident that is in the track.
const TRACKED_BEFORE_SECS: f64 = 2.0;
const TRACKED_AFTER_SECS: f64 = 3.0;
/// Number of samples that are kept, the newest ones: 17 minutes.
const MAX_SAMPLES: usize = 20_000;

/// The incidents of a log, for viewers.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Incidents {
    /// The program that wrote the log.
    pub program: String,
    /// When the log began, milliseconds since 1970.
    pub began_unix_millis: u64,
    /// Time from the beginning of the log to its end.
    pub seconds: f64,
    /// Pose of the frame of all places in the world: that of the arm's base, or no motion if the base
    /// is steered. x, y, z in meters, and a quaternion x, y, z, w.
    pub world_from_base: [f64; 7],
    /// Names of the joints, in the order of all positions.
    pub joint_names: Vec<String>,
    /// The incidents in the order of time.
    pub incidents: VecDeque<Incident>,
    /// Where the arm was around the incidents, in the order of time.
    pub track: VecDeque<Sample>,
    /// Number of older incidents that are left out.
    pub left_out: u64,
    /// Why the rest of the log cannot be read.
    pub damage: Option<String>,
}

/// One incident.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Incident {
    /// Time since the beginning of the log.
    pub seconds: f64,
    /// Kind of incident.
    pub kind: IncidentKind,
    /// Description in words.
    pub text: String,
    /// Where it happened: in the frame of the arm's base, or in the world if the base is steered,
    /// meters.
    pub place: Option<[f64; 3]>,
    /// The operator in control.
    pub operator: Option<u64>,
    /// Positions of the joints, radians or meters.
    pub position: Vec<f64>,
    /// The last target of the joints; `None` if the arm followed none.
    pub target: Option<Vec<f64>>,
    /// View of the operator, `world_from_camera`: x, y, z in meters, and a quaternion x, y, z, w.
    pub view: Option<[f64; 7]>,
    /// Pose of the base, if it is steered: x, y, z in meters, and a quaternion x, y, z, w.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub world_from_base: Option<[f64; 7]>,
}

/// The kind of an incident.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum IncidentKind {
    /// Control was taken, offered or lost.
    Lease,
    /// The arm was stopped until an operator permits motion, or motion was permitted again.
    Stop,
    /// The robot braked while it followed an operator.
    Brake,
    /// A request, or a part of a motion, was refused.
    Refused,
    /// The arm was slower because of something near.
    Slowed,
}

/// Reads the incidents of a log.
///
/// * `files`: files of the log, the older one first.
///
/// # Errors
///
/// If a file is not a steering log.
pub fn incidents(files: &[PathBuf]) -> anyhow::Result<Incidents> {
    let mut history = History::default();
    for file in files {
        history.read(file)?;
    }
    Ok(history.found)
}

/// Where the arm was at a time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Sample {
    /// Time since the beginning of the log.
    pub seconds: f64,
    /// Positions of the joints, rounded to 0.0001 rad or m.
    pub position: Vec<f64>,
    /// The target, rounded like the positions; `None` if the arm followed none.
    pub target: Option<Vec<f64>>,
    /// Pose of the base, if it is steered, rounded like the positions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub world_from_base: Option<[f64; 7]>,
}

/// State of the log up to a line.
#[derive(Default)]
struct History {
    found: Incidents,
    began: Option<Stamp>,
    now: Stamp,
    position: Vec<f64>,
    target: Option<Vec<f64>>,
    /// The last decision; `None` before the first, and after missing entries.
    decided: Option<Decided>,
    /// What a stop of the robot stops.
    robot: &'static str,
    /// Pose of the base, if it is steered.
    world_from_base: Option<[f64; 7]>,
    holder: Option<Operator>,
    view: Option<[f64; 7]>,
    /// The track of the last seconds, in case that an incident follows.
    recent: VecDeque<Sample>,
    /// Time of the last sample of the track, in seconds of the log.
    sampled_secs: Option<f64>,
    /// Until when the track continues because of the last incident.
    tracked_until_secs: f64,
    /// Limits and refusals that were applied last at a time.
    episodes: Vec<(Episode, Stamp)>,
}

/// A limit, and the place of its reason.
struct PlacedLimit {
    limit: Limit,
    place: Option<[f64; 3]>,
}

/// The parts of a decision from which incidents follow.
struct Decided {
    limits: Vec<Limit>,
    /// Whether the robot followed an operator.
    is_following: bool,
}

/// Limits or refusals with equal episodes belong to one incident. Their numbers may differ.
#[derive(Clone, Copy, PartialEq)]
struct Episode {
    kind: IncidentKind,
    reason: Discriminant<Reason>,
}

impl History {
    fn read(&mut self, file: &Path) -> anyhow::Result<()> {
        let mut lines = LogReader::open(file)?;
        while let Some(line) = lines.next()? {
            match line {
                Line::Start(start) => self.start(&start),
                Line::Entry(entry) => self.entry(&entry),
                Line::View(view) => self.view = Some(view.world_from_camera),
                Line::Missing(_) => self.decided = None,
                Line::End(end) => self.advance(end.at),
            }
        }
        self.found.damage = lines.damage().map(str::to_owned);
        Ok(())
    }

    fn start(&mut self, start: &Start) {
        self.begin(start.at, start.unix_millis, &start.program);
        let setup = &start.setup;
        self.found.world_from_base = match &setup.base {
            Some(_) => [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
            None => start.world_from_base,
        };
        self.robot = match (&setup.arm, &setup.base) {
            (Some(_), Some(_)) => "robot",
            (None, Some(_)) => "base",
            (_, None) => "arm",
        };
        if let Some(stowed) = setup.base.as_ref().and_then(|base| base.stowed.as_ref()) {
            self.found.joint_names.clone_from(&stowed.joints);
        }
        if let Some(arm) = &setup.arm
            && let Ok(chain) = Chain::from_urdf(&arm.urdf, &arm.base_link, &arm.tip_link)
        {
            self.found.joint_names = chain.joint_names().to_vec();
        }
        self.advance(start.at);
    }

    fn begin(&mut self, at: Stamp, unix_millis: u64, program: &str) {
        if self.began.is_none() {
            self.began = Some(at);
            self.found.began_unix_millis = unix_millis;
        }
        program.clone_into(&mut self.found.program);
    }

    fn advance(&mut self, at: Stamp) {
        self.now = at;
        self.found.seconds = at.secs_since(self.began.unwrap_or(at));
    }

    fn entry(&mut self, entry: &Entry) {
        self.advance(entry.at());
        match entry {
            Entry::Request {
                request, refusal, ..
            } => self.answer(request, refusal.as_ref()),
            Entry::Cycle { arm, base, .. } => self.robot_cycle(arm.as_deref(), base.as_deref()),
        }
    }

    fn robot_cycle(&mut self, arm: Option<&ArmCycle>, base: Option<&BaseCycle>) {
        if let Some(base) = base {
            let situation = &base.situation;
            if let Some(seen) = &situation.pose {
                self.world_from_base = Some(pose_numbers(seen));
            }
            if let Some(arm) = &situation.arm {
                self.position.clone_from(&arm.position);
            }
        }
        if let Some(arm) = arm {
            self.position.clone_from(&arm.state.position);
        }
        let arm_target = arm.and_then(|arm| arm.verdict.target());
        let is_following =
            arm_target.is_some() || base.is_some_and(|base| base.verdict.target().is_some());
        let limits = self.limits(arm, base);
        self.cycle(&limits, is_following);
        self.target = arm_target.map(|target| target.position.clone());
        self.sample();
    }

    /// The limits of all parts. A part that rests because its operator moves the other one is no
    /// incident.
    fn limits(&self, arm: Option<&ArmCycle>, base: Option<&BaseCycle>) -> Vec<PlacedLimit> {
        let of_arm = arm.map_or(&[][..], |arm| &arm.verdict.limits);
        let of_base = base.map_or(&[][..], |base| &base.verdict.limits);
        let world_from_base = self.world_from_base.map(transform::from_xyz_xyzw);
        let mut limits: Vec<PlacedLimit> = Vec::new();
        for limit in of_arm {
            let place = limit.reason.place();
            // With a base that is steered, all places are in the world.
            let moved = |place: [f64; 3]| match &world_from_base {
                Some(pose) => (pose * Point3::from(place)).into(),
                None => place,
            };
            limits.push(PlacedLimit {
                limit: limit.clone(),
                place: place.map(moved),
            });
        }
        for limit in of_base {
            if !of_arm.contains(limit) {
                limits.push(PlacedLimit {
                    limit: limit.clone(),
                    place: limit.reason.place(),
                });
            }
        }
        let is_incident =
            |it: &PlacedLimit| !matches!(it.limit.reason, Reason::ArmHasGrip | Reason::BaseHasGrip);
        limits.retain(is_incident);
        limits
    }

    fn answer(&mut self, request: &Request, refusal: Option<&Reason>) {
        match refusal {
            Some(reason) => self.refusal(request, reason),
            None => self.request(request),
        }
    }

    fn refusal(&mut self, request: &Request, reason: &Reason) {
        let what = match request {
            Request::Command(_) => "a command",
            Request::Stop { .. } => "a stop",
            Request::Rearm { .. } => "permission to move",
            _ => "control",
        };
        self.episode(IncidentKind::Refused, (reason, reason.place()), || {
            format!("{what} was refused: {reason}")
        });
    }

    fn request(&mut self, request: &Request) {
        match request {
            Request::TakeLease(operator) => {
                if self.holder != Some(*operator) {
                    self.holder = Some(*operator);
                    self.add(
                        IncidentKind::Lease,
                        format!("{operator} took control"),
                        None,
                    );
                }
            }
            Request::ReleaseLease(operator) => {
                self.add(
                    IncidentKind::Lease,
                    format!("{operator} gave up control"),
                    None,
                );
                self.holder = None;
            }
            Request::OfferLease { from, to } => {
                let text = format!("{from} offered control to {to}");
                self.add(IncidentKind::Lease, text, None);
            }
            Request::Stop { by } => {
                let who = by.map_or("the program".to_owned(), |operator| operator.to_string());
                let what = self.robot;
                self.add(
                    IncidentKind::Stop,
                    format!("{who} stopped the {what}"),
                    None,
                );
            }
            Request::Rearm { operator, .. } => {
                let text = format!("{operator} permitted motion again");
                self.add(IncidentKind::Stop, text, None);
            }
            Request::SceneLost { report } => {
                let text = format!("the map of the scene has ended: {report}");
                self.add(IncidentKind::Stop, text, None);
            }
            Request::RenewLease(_) | Request::Command(_) => {}
        }
    }

    fn cycle(&mut self, limits: &[PlacedLimit], is_following: bool) {
        let before = self.decided.replace(Decided {
            limits: limits.iter().map(|it| it.limit.clone()).collect(),
            is_following,
        });
        for PlacedLimit { limit, place } in limits {
            let text = || limit.to_string();
            match limit.effect {
                Effect::Braked => self.brake(limit, *place, before.as_ref()),
                Effect::Refused => {
                    self.episode(IncidentKind::Refused, (&limit.reason, *place), text);
                }
                // Limits of speed apply to nearly every motion.
                Effect::Slowed(_)
                    if matches!(limit.link, Link::SelfCollision | Link::Clearance) =>
                {
                    self.episode(IncidentKind::Slowed, (&limit.reason, *place), text);
                }
                Effect::Slowed(_) => {}
            }
        }
    }

    /// The arm must be at rest in this cycle.
    fn brake(&mut self, limit: &Limit, place: Option<[f64; 3]>, before: Option<&Decided>) {
        let reason = &limit.reason;
        let is_same = |other: &Limit| {
            other.effect == Effect::Braked && discriminant(&other.reason) == discriminant(reason)
        };
        let is_new = before.is_none_or(|before| !before.limits.iter().any(is_same));
        let was_following = before.is_some_and(|before| before.is_following);
        let kind = match reason {
            // The request itself is an incident.
            Reason::StoppedBy { .. } | Reason::StoppedByProgram | Reason::LeaseGivenUp { .. } => {
                return;
            }
            Reason::LeaseExpired { .. } | Reason::ClockWentBack { .. } => IncidentKind::Lease,
            Reason::ArmStopped { .. } | Reason::BaseStopped { .. } => IncidentKind::Stop,
            Reason::ArmSilent { .. } | Reason::ArmReport { .. } | Reason::BaseSilent { .. } => {
                IncidentKind::Brake
            }
            _ if was_following => IncidentKind::Brake,
            _ => return,
        };
        if !is_new {
            return;
        }
        self.add(kind, limit.to_string(), place);
        if kind == IncidentKind::Lease {
            self.holder = None;
        }
    }

    /// Adds a sample to the track, or to what would be its beginning.
    fn sample(&mut self) {
        let seconds = self.found.seconds;
        let is_due = self
            .sampled_secs
            .is_none_or(|last| seconds - last >= SAMPLE_SECS);
        if !is_due {
            return;
        }
        self.sampled_secs = Some(seconds);
        let sample = Sample {
            seconds,
            position: rounded(&self.position),
            target: self.target.as_deref().map(rounded),
            world_from_base: self.world_from_base,
        };
        if seconds <= self.tracked_until_secs {
            self.track(sample);
            return;
        }
        self.recent.push_back(sample);
        let begin_secs = seconds - TRACKED_BEFORE_SECS;
        while self
            .recent
            .front()
            .is_some_and(|it| it.seconds < begin_secs)
        {
            self.recent.pop_front();
        }
    }

    fn track(&mut self, sample: Sample) {
        self.found.track.push_back(sample);
        if self.found.track.len() > MAX_SAMPLES {
            self.found.track.pop_front();
        }
    }

    /// Adds an incident unless it continues an earlier one.
    fn episode(
        &mut self,
        kind: IncidentKind,
        (reason, place): (&Reason, Option<[f64; 3]>),
        text: impl FnOnce() -> String,
    ) {
        let episode = Episode {
            kind,
            reason: discriminant(reason),
        };
        let now = self.now;
        self.episodes
            .retain(|(_, last)| now.secs_since(*last) <= EPISODE_SECS);
        if let Some((_, last)) = self
            .episodes
            .iter_mut()
            .find(|(other, _)| *other == episode)
        {
            *last = now;
            return;
        }
        self.episodes.push((episode, now));
        self.add(kind, text(), place);
    }

    fn add(&mut self, kind: IncidentKind, text: String, place: Option<[f64; 3]>) {
        self.found.incidents.push_back(Incident {
            seconds: self.found.seconds,
            kind,
            text,
            place,
            operator: self.holder.map(|Operator(number)| number),
            position: self.position.clone(),
            target: self.target.clone(),
            view: self.view,
            world_from_base: self.world_from_base,
        });
        self.tracked_until_secs = self.found.seconds + TRACKED_AFTER_SECS;
        for sample in std::mem::take(&mut self.recent) {
            self.track(sample);
        }
        if self.found.incidents.len() > MAX_INCIDENTS {
            self.found.incidents.pop_front();
            self.found.left_out += 1;
        }
    }
}

fn rounded(positions: &[f64]) -> Vec<f64> {
    positions.iter().map(|q| rounded_number(*q)).collect()
}

fn rounded_number(number: f64) -> f64 {
    const STEPS: f64 = 1e4;
    (number * STEPS).round() / STEPS
}

/// A pose on the floor as x, y, z and a quaternion x, y, z, w.
fn pose_numbers(seen: &SeenPose) -> [f64; 7] {
    let (sin, cos) = (0.5 * seen.pose.yaw_rad).sin_cos();
    [seen.pose.x_m, seen.pose.y_m, seen.z_m, 0.0, 0.0, sin, cos].map(rounded_number)
}
