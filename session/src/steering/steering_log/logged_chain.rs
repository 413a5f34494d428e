//! The chains of decisions whose entries are logged: the chain of an arm, and the chain of a base.

use super::line::{BaseStart, Line, Start, VERSION};
use drivers::base_motion::BaseOutput;
use drivers::motion::Output;
use kinematics::{Stamp, Transform, transform};
use std::time::{SystemTime, UNIX_EPOCH};
use steering::{
    BaseEntry, BaseSteering, BaseSteeringState, BaseVerdict, Entry, State, Steering, Verdict,
};

/// A chain of decisions that is logged.
pub(in crate::steering) trait LoggedChain {
    /// All that the chain remembers.
    type State;
    /// One input, and the decision.
    type Entry;
    /// The decision of one cycle.
    type Verdict: Clone + PartialEq;
    /// Content of a log besides decisions.
    type About;

    /// The state now.
    fn state(&self) -> Self::State;

    /// Takes the entries since the last call, and the number of entries that were dropped.
    fn take_record(&mut self) -> (Vec<Self::Entry>, u64);

    /// The line with which a log can begin.
    ///
    /// * `state`: the state before the first entry.
    fn start_line(&self, at: Stamp, about: &Self::About, state: Self::State) -> Line;

    /// The line of an entry.
    fn line(entry: Self::Entry) -> Line;

    /// The cycle of an entry; `None` for a request.
    fn cycle(entry: &Self::Entry) -> Option<LoggedCycle<'_, Self::Verdict>>;

    /// Whether two states differ at most in the times of the last calls.
    fn are_equal_except_times(a: &Self::State, b: &Self::State) -> bool;
}

/// The parts of a cycle on which its log depends.
pub(in crate::steering) struct LoggedCycle<'a, V> {
    pub(in crate::steering) verdict: &'a V,
    /// Whether the robot must be at rest.
    pub(in crate::steering) is_braking: bool,
    /// Whether the robot is at rest.
    pub(in crate::steering) is_at_rest: bool,
}

/// Content of the log of an arm besides decisions.
#[derive(Clone, Debug)]
pub(in crate::steering) struct About {
    /// The robot description.
    pub(in crate::steering) urdf: String,
    /// Pose of the base of the arm.
    pub(in crate::steering) world_from_base: Transform,
}

impl LoggedChain for Steering {
    type State = State;
    type Entry = Entry;
    type Verdict = Verdict;
    type About = About;

    fn state(&self) -> State {
        self.state()
    }

    fn take_record(&mut self) -> (Vec<Entry>, u64) {
        self.take_record()
    }

    fn start_line(&self, at: Stamp, about: &About, state: State) -> Line {
        Line::Start(Box::new(Start {
            version: VERSION,
            program: program(),
            at,
            unix_millis: unix_millis(),
            world_from_base: transform::to_xyz_xyzw(&about.world_from_base),
            setup: self.setup(about.urdf.clone()).with_state(state),
        }))
    }

    fn line(entry: Entry) -> Line {
        Line::Entry(Box::new(entry))
    }

    fn cycle(entry: &Entry) -> Option<LoggedCycle<'_, Verdict>> {
        match entry {
            Entry::Request { .. } => None,
            Entry::Cycle { arm, verdict, .. } => Some(LoggedCycle {
                verdict,
                is_braking: verdict.output == Output::Brake,
                is_at_rest: arm.is_at_rest,
            }),
        }
    }

    fn are_equal_except_times(a: &State, b: &State) -> bool {
        a.is_equal_except_times(b)
    }
}

impl LoggedChain for BaseSteering {
    type State = BaseSteeringState;
    type Entry = BaseEntry;
    type Verdict = BaseVerdict;
    type About = ();

    fn state(&self) -> BaseSteeringState {
        self.state()
    }

    fn take_record(&mut self) -> (Vec<BaseEntry>, u64) {
        self.take_record()
    }

    fn start_line(&self, at: Stamp, (): &(), state: BaseSteeringState) -> Line {
        Line::BaseStart(Box::new(BaseStart {
            version: VERSION,
            program: program(),
            at,
            unix_millis: unix_millis(),
            setup: self.setup().with_state(state),
        }))
    }

    fn line(entry: BaseEntry) -> Line {
        Line::BaseEntry(Box::new(entry))
    }

    fn cycle(entry: &BaseEntry) -> Option<LoggedCycle<'_, BaseVerdict>> {
        match entry {
            BaseEntry::Request { .. } => None,
            BaseEntry::Cycle {
                situation, verdict, ..
            } => Some(LoggedCycle {
                verdict,
                is_braking: verdict.output == BaseOutput::Brake,
                is_at_rest: situation.base.is_at_rest,
            }),
        }
    }

    fn are_equal_except_times(a: &BaseSteeringState, b: &BaseSteeringState) -> bool {
        a.is_equal_except_time(b)
    }
}

/// Version and processor of the program.
fn program() -> String {
    format!(
        "fieldrig {} {}",
        env!("CARGO_PKG_VERSION"),
        std::env::consts::ARCH
    )
}

fn unix_millis() -> u64 {
    #[expect(clippy::disallowed_methods, reason = "only shown; no time is measured")]
    let since_epoch = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    u64::try_from(since_epoch.as_millis()).unwrap_or(u64::MAX)
}
