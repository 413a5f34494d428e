//! The faults that an arm must survive, and how the client of an operator causes them.

use super::arms::ArmKind;
use super::client::{ClockError, SteeringClient};
use super::link::LinkFault;
use super::operator::{Hand, Operator, hand_at};
use anyhow::Result;
use nalgebra::Vector3;
use serde::Serialize;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// How long a thread is held.
const HELD: Duration = Duration::from_secs(2);
/// Time between two messages that only keep the lease.
const RENEW_PERIOD: Duration = Duration::from_millis(500);
/// Step of the clock of a device, microseconds.
const CLOCK_STEP_MICROS: f64 = 5e6;
/// Age of stale samples, microseconds. The server accepts samples up to 0.3 s old.
const STALE_MICROS: f64 = 0.5e6;
/// Distance of a jump of the hand, meters: much more than a hand moves between two samples.
const JUMP_M: f64 = 1.0;
/// Distance of a goal that no arm reaches, meters.
const FAR_M: f64 = 5.0;
/// Maximum time from a release, or from what counts as one, to the beginning of the brake,
/// milliseconds.
const RELEASE: f64 = 100.0;
/// Maximum time from the last valid message to the beginning of the brake, milliseconds. A release
/// that is lost looks like silence.
const SILENCE: f64 = 150.0;

/// A fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    /// The operator releases the dead-man switch.
    Released,
    /// The page is hidden: it opens the switch, and only keeps the lease.
    PageHidden,
    /// The page is closed.
    PageClosed,
    /// The connection ends without a farewell.
    PageCrashed,
    /// No message arrives in either direction.
    LinkCut,
    /// The client stays connected, and sends nothing.
    PageFrozen,
    /// The device sends nothing, and the page keeps the lease.
    DeviceSilent,
    /// The thread of the server for pages and pictures is held.
    PagesHeld,
    /// The thread of the server for steering is held.
    ServerHeld,
    /// The thread of the decisions is held: the map of free space answers late.
    DecisionsHeld,
    /// The map of free space does not answer, as if its input was blocked.
    ClearanceMissing,
    /// The clock of the device steps forward.
    ClockAhead,
    /// The clock of the device steps back.
    ClockBehind,
    /// The operator has offered control to another one, who takes it.
    OperatorReplaced,
    /// Somebody else stops the arm.
    StoppedByOther,
    /// All samples are old when they arrive.
    Stale,
    /// The same message arrives again and again.
    Replayed,
    /// Each message arrives twice.
    Duplicated,
    /// Each second message overtakes the one before it.
    Reordered,
    /// The pose of the hand is not finite.
    NotFinite,
    /// The hand jumps by a meter.
    HandJumps,
    /// The goal is five meters away.
    FarGoal,
    /// The link loses one packet in twenty.
    Loss5,
    /// The link loses one packet in seven.
    Loss15,
    /// The program that moves the robot is stopped by a signal.
    ProgramStopped,
    /// The program that moves the robot is killed.
    ProgramKilled,
}

/// Reason for which the arm brakes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Event {
    /// The beginning of the fault.
    Fault,
    /// The release of the switch, while the fault lasts. The fault alone must not end the motion.
    Release,
}

/// Properties of a fault.
struct Entry {
    name: &'static str,
    title: &'static str,
    goal_millis: f64,
    event: Event,
}

fn entry(name: &'static str, title: &'static str, goal_millis: f64, event: Event) -> Entry {
    Entry {
        name,
        title,
        goal_millis,
        event,
    }
}

impl Serialize for Fault {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl Fault {
    /// All faults, in the order of the tables.
    pub const ALL: [Self; 26] = [
        Self::Released,
        Self::PageHidden,
        Self::PageClosed,
        Self::PageCrashed,
        Self::LinkCut,
        Self::PageFrozen,
        Self::DeviceSilent,
        Self::PagesHeld,
        Self::ServerHeld,
        Self::DecisionsHeld,
        Self::ClearanceMissing,
        Self::ClockAhead,
        Self::ClockBehind,
        Self::OperatorReplaced,
        Self::StoppedByOther,
        Self::Stale,
        Self::Replayed,
        Self::Duplicated,
        Self::Reordered,
        Self::NotFinite,
        Self::HandJumps,
        Self::FarGoal,
        Self::Loss5,
        Self::Loss15,
        Self::ProgramStopped,
        Self::ProgramKilled,
    ];

    /// The name of the fault for flags.
    #[must_use]
    pub fn name(self) -> &'static str {
        self.entry().name
    }

    /// Description for tables.
    #[must_use]
    pub fn title(self) -> &'static str {
        self.entry().title
    }

    /// Whether the fault can happen to a robot. A base has no map of free space yet, and follows
    /// velocities, neither hands nor poses of a tip.
    #[must_use]
    pub fn concerns(self, kind: ArmKind) -> bool {
        let is_of_arms = matches!(
            self,
            Self::DecisionsHeld | Self::ClearanceMissing | Self::HandJumps | Self::FarGoal
        );
        let has_own_rules = !self.ends_program() || kind.is_device();
        has_own_rules && !(is_of_arms && kind.is_base())
    }

    /// Whether the program ends, so that only the device can brake.
    #[must_use]
    pub fn ends_program(self) -> bool {
        matches!(self, Self::ProgramStopped | Self::ProgramKilled)
    }

    /// Maximum time from the event to the beginning of the brake, milliseconds.
    #[must_use]
    pub fn goal_millis(self) -> f64 {
        self.entry().goal_millis
    }

    /// Reason for which the arm brakes.
    pub(super) fn event(self) -> Event {
        self.entry().event
    }

    fn entry(self) -> Entry {
        match self {
            Self::Released => entry(
                "released",
                "dead-man switch released",
                RELEASE,
                Event::Fault,
            ),
            Self::PageHidden => entry("page-hidden", "page hidden", RELEASE, Event::Fault),
            Self::PageClosed => entry("page-closed", "page closed", SILENCE, Event::Fault),
            Self::PageCrashed => entry(
                "page-crashed",
                "connection ends without farewell",
                SILENCE,
                Event::Fault,
            ),
            Self::LinkCut => entry("link-cut", "link cut", SILENCE, Event::Fault),
            Self::PageFrozen => entry(
                "page-frozen",
                "page frozen: connected, no messages",
                SILENCE,
                Event::Fault,
            ),
            Self::DeviceSilent => entry(
                "device-silent",
                "device silent, page keeps the lease",
                SILENCE,
                Event::Fault,
            ),
            Self::PagesHeld => entry(
                "pages-held",
                "server thread of pages held 2 s, then released",
                RELEASE,
                Event::Release,
            ),
            Self::ServerHeld => entry(
                "server-held",
                "server thread of steering held 2 s",
                SILENCE,
                Event::Fault,
            ),
            Self::DecisionsHeld => entry(
                "decisions-held",
                "thread of decisions held 2 s",
                SILENCE,
                Event::Fault,
            ),
            Self::ClearanceMissing => entry(
                "clearance-missing",
                "no answer of the map of free space for 2 s",
                SILENCE,
                Event::Fault,
            ),
            Self::ClockAhead => entry(
                "clock-ahead",
                "clock of the device 5 s ahead",
                SILENCE,
                Event::Fault,
            ),
            Self::ClockBehind => entry(
                "clock-behind",
                "clock of the device 5 s back",
                SILENCE,
                Event::Fault,
            ),
            Self::OperatorReplaced => entry(
                "operator-replaced",
                "another operator takes over",
                RELEASE,
                Event::Fault,
            ),
            Self::StoppedByOther => entry(
                "stopped-by-other",
                "stopped by another client",
                RELEASE,
                Event::Fault,
            ),
            Self::Stale => entry("stale", "samples 0.5 s old", SILENCE, Event::Fault),
            Self::Replayed => entry("replayed", "last message repeated", SILENCE, Event::Fault),
            Self::Duplicated => entry(
                "duplicated",
                "each message twice, then released",
                RELEASE,
                Event::Release,
            ),
            Self::Reordered => entry(
                "reordered",
                "messages swapped, then released",
                RELEASE,
                Event::Release,
            ),
            Self::NotFinite => entry("not-finite", "pose not finite", SILENCE, Event::Fault),
            Self::HandJumps => entry("hand-jumps", "hand jumps 1 m", RELEASE, Event::Fault),
            Self::FarGoal => entry(
                "far-goal",
                "goal 5 m away, then released",
                RELEASE,
                Event::Release,
            ),
            Self::Loss5 => entry("loss-5", "5 % loss, then released", SILENCE, Event::Release),
            Self::Loss15 => entry(
                "loss-15",
                "15 % loss, then released",
                SILENCE,
                Event::Release,
            ),
            Self::ProgramStopped => entry(
                "program-stopped",
                "program stopped (SIGSTOP)",
                SILENCE,
                Event::Fault,
            ),
            Self::ProgramKilled => entry(
                "program-killed",
                "program killed (SIGKILL)",
                SILENCE,
                Event::Fault,
            ),
        }
    }

    /// Prepares the fault while the arm is still moved as usual.
    pub(super) fn prepare(self, operator: &Operator<'_>, other: &SteeringClient) -> Result<()> {
        if self == Self::OperatorReplaced {
            operator.client.offer_lease(other.number())?;
            let is_offered = Some(other.number());
            let state = other.wait_for_state("the offer", |state| state.offered_to == is_offered);
            state.map(drop)?;
        }
        Ok(())
    }

    /// Begins the fault.
    pub(super) fn begin(self, operator: &mut Operator<'_>, other: &SteeringClient) -> Result<()> {
        let (client, rig) = (&mut operator.client, operator.rig);
        let loss = |loss_frac| LinkFault {
            loss_frac,
            ..LinkFault::default()
        };
        match self {
            Self::Released | Self::PageHidden => {
                let open = operator.open_sample();
                operator.client.send(&open)?;
            }
            Self::PageClosed => client.disconnect(true),
            Self::PageCrashed => client.disconnect(false),
            Self::LinkCut => client.set_link(LinkFault {
                is_cut: true,
                ..LinkFault::default()
            }),
            Self::PagesHeld => rig.server.block(viz::ServerThread::Pages, HELD),
            Self::ServerHeld => rig.server.block(viz::ServerThread::Steering, HELD),
            Self::DecisionsHeld => rig.scene.block_answers(HELD),
            Self::ClearanceMissing => rig.scene.miss_answers(HELD),
            Self::ClockAhead => client.clock_error = ClockError(CLOCK_STEP_MICROS),
            Self::ClockBehind => client.clock_error = ClockError(-CLOCK_STEP_MICROS),
            Self::Stale => client.clock_error = ClockError(-STALE_MICROS),
            Self::OperatorReplaced => other.lease("take")?,
            Self::StoppedByOther => other.stop()?,
            Self::Loss5 => client.set_link(loss(0.05)),
            Self::Loss15 => client.set_link(loss(0.15)),
            Self::PageFrozen
            | Self::DeviceSilent
            | Self::Replayed
            | Self::Duplicated
            | Self::Reordered
            | Self::NotFinite
            | Self::HandJumps
            | Self::FarGoal
            | Self::ProgramStopped
            | Self::ProgramKilled => {}
        }
        Ok(())
    }

    /// Ends the fault, so that the next trial can begin.
    pub(super) fn end(self, operator: &mut Operator<'_>, other: &SteeringClient) -> Result<()> {
        operator.rig.scene.answer();
        operator.client.clock_error = ClockError::default();
        if matches!(self, Self::LinkCut | Self::Loss5 | Self::Loss15) {
            // Waiting messages must not arrive during the next trial.
            operator.client.disconnect(false);
            operator.client.set_link(LinkFault::default());
        }
        if self == Self::OperatorReplaced {
            other.lease("release")?;
        }
        Ok(())
    }
}

/// Messages of the client while a fault lasts.
pub(super) struct FaultyDevice {
    fault: Fault,
    /// The newest message that was sent in time.
    last: Option<Value>,
    /// A message that is overtaken by the next one.
    held_back: Option<Value>,
    renewed_at: Instant,
}

impl FaultyDevice {
    pub(super) fn new(fault: Fault, last: Option<Value>) -> Self {
        Self {
            fault,
            last,
            held_back: None,
            renewed_at: Instant::now(),
        }
    }

    /// Sends the message of the fault instead of a sample of the hand. The connection may
    /// have ended.
    pub(super) fn send(&mut self, operator: &mut Operator<'_>, hand: &Hand) -> Result<()> {
        let intent = operator.intent(hand);
        match self.fault {
            Fault::PageClosed | Fault::PageCrashed | Fault::PageFrozen => Ok(()),
            Fault::Released => {
                let open = operator.open_sample();
                operator.client.send(&open)
            }
            Fault::PageHidden | Fault::DeviceSilent => self.renew(operator),
            Fault::Replayed => match &self.last {
                Some(last) => operator.client.send(last),
                None => Ok(()),
            },
            Fault::Duplicated => {
                let sample = operator.closed_sample(&intent);
                operator.client.send(&sample)?;
                operator.client.send(&sample)
            }
            Fault::Reordered => {
                let sample = operator.closed_sample(&intent);
                match self.held_back.take() {
                    Some(held_back) => {
                        operator.client.send(&sample)?;
                        operator.client.send(&held_back)
                    }
                    None => {
                        self.held_back = Some(sample);
                        Ok(())
                    }
                }
            }
            Fault::NotFinite => {
                let sample = operator.closed_sample(&operator.intent(&Hand::AT_REST));
                // JSON has no number that is not finite, so this one is too large.
                let text = sample.to_string();
                let text = if operator.rig.robot.kind.is_base() {
                    text.replacen("\"yaw_rad_s\":0.0", "\"yaw_rad_s\":1e999", 1)
                } else {
                    text.replacen("[0.0,", "[1e999,", 1)
                };
                operator.client.send_text(&text)
            }
            Fault::HandJumps => {
                let jumped_m = hand.at_m + Vector3::new(0.0, 0.0, JUMP_M);
                let sample = operator.closed_sample(&hand_at(jumped_m));
                operator.client.send(&sample)
            }
            Fault::FarGoal => {
                let direction = hand.at_m.try_normalize(0.0).unwrap_or_else(Vector3::x);
                let [x, y, z]: [f64; 3] = (direction * FAR_M).into();
                let intent =
                    json!({ "kind": "pose", "base_from_tip": [x, y, z, 1.0, 0.0, 0.0, 0.0] });
                let sample = operator.closed_sample(&intent);
                operator.client.send(&sample)
            }
            _ => {
                let sample = operator.closed_sample(&intent);
                operator.client.send(&sample)
            }
        }
    }

    fn renew(&mut self, operator: &Operator<'_>) -> Result<()> {
        if self.renewed_at.elapsed() < RENEW_PERIOD {
            return Ok(());
        }
        self.renewed_at = Instant::now();
        operator.client.lease("renew")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn all_faults_are_listed_once_with_names_of_their_own() {
        let names: BTreeSet<&str> = Fault::ALL.iter().map(|fault| fault.name()).collect();
        assert_eq!(names.len(), Fault::ALL.len());
    }
}
