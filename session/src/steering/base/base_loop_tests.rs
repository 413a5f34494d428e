//! The loop of a base with a thread that drives an ideal base. Nothing depends on the speed of the
//! machine: the tests wait for conditions, and grip again if the base has braked meanwhile.

use super::robot_watch::SeenRobot;
use crate::steering::NoScene;
use crate::steering::steering_log::{About, files_of, incidents, replay};
use crate::steering::steering_loop::{Outcome, Reply, Reports, SteeringLoop};
use crate::steering::time_base::TimeBase;
use drivers::base_motion::{BaseDrive, BaseLimits, BaseReport, BaseVelocity, MovableBase};
use drivers::clock;
use kinematics::{Stamp, Transform};
use parking_lot::Mutex;
use std::sync::Arc;
use std::time::{Duration, Instant};
use steering::{BaseSteeringConfig, FloorPose, SeenPose};
use viz::{
    ReceivedRequest, RefusedRequest, SteeringCommand, SteeringIntent, SteeringRequest,
    SteeringState,
};

const ANA: u64 = 1;
const BEN: u64 = 2;
/// Maximum time until something happens, on a busy machine.
const TIMEOUT: Duration = Duration::from_secs(60);
const LIMITS: BaseLimits = BaseLimits {
    max_forward_m_s: 0.5,
    max_left_m_s: 0.0,
    max_yaw_rad_s: 1.0,
    acceleration_m_s2: 1.0,
    yaw_acceleration_rad_s2: 2.0,
    brake_m_s2: 2.0,
    brake_yaw_rad_s2: 4.0,
};

/// A base that reaches every velocity immediately.
#[derive(Clone, Default)]
struct IdealBase(Arc<Mutex<BaseVelocity>>);

impl MovableBase for IdealBase {
    fn drive(&mut self, _now: Stamp, velocity: &BaseVelocity) -> Result<(), drivers::Error> {
        *self.0.lock() = *velocity;
        Ok(())
    }

    fn report(&mut self, now: Stamp) -> BaseReport {
        let velocity = *self.0.lock();
        BaseReport {
            reported_at: Some(now),
            velocity,
            is_stop_confirmed: velocity == BaseVelocity::ZERO,
            is_on_tour: false,
            fault: None,
            refusal: None,
        }
    }
}

struct Test {
    base: IdealBase,
    drive: BaseDrive,
    base_loop: SteeringLoop,
    sequence: u64,
    grip: u64,
}

impl Test {
    fn new() -> Self {
        let base = IdealBase::default();
        let drive = BaseDrive::start(Box::new(base.clone()), LIMITS).expect("valid limits");
        let config = BaseSteeringConfig {
            area_m: Some([-1.0, -1.0, 1.0, 1.0]),
            ..BaseSteeringConfig::new(LIMITS)
        };
        let base_loop = SteeringLoop::of_base(config, drive.port().clone(), TimeBase::now());
        Self {
            base,
            drive,
            base_loop: base_loop.expect("a valid configuration"),
            sequence: 0,
            grip: 0,
        }
    }

    fn cycle(&mut self, requests: &[(u64, SteeringRequest)]) -> Outcome {
        std::thread::sleep(Duration::from_millis(5));
        let now = clock::now();
        let received: Vec<ReceivedRequest> = requests
            .iter()
            .map(|(client, request)| ReceivedRequest {
                client: *client,
                received_at: Instant::now(),
                request: request.clone(),
            })
            .collect();
        let pose = FloorPose {
            x_m: 0.0,
            y_m: 0.5,
            yaw_rad: 0.0,
        };
        let seen = SeenRobot {
            pose: Some(SeenPose {
                at: now,
                pose,
                z_m: 0.25,
            }),
            posture: None,
        };
        let reports = Reports {
            arm: None,
            robot: seen,
        };
        self.base_loop.cycle(now, &received, &reports, &NoScene)
    }

    fn command(&mut self, grip: Option<u64>, intent: SteeringIntent) -> SteeringRequest {
        self.sequence += 1;
        SteeringRequest::Command(SteeringCommand {
            device: 7,
            sequence: self.sequence,
            captured_at: Instant::now(),
            grip,
            intent: Some(intent),
        })
    }

    /// Holds the switch until the state is as it should be. Grips again if the base has braked.
    fn hold_until(
        &mut self,
        intent: &SteeringIntent,
        mut is_reached: impl FnMut(&SteeringState, BaseVelocity) -> bool,
    ) -> SteeringState {
        let began = Instant::now();
        let mut was_braking = true;
        loop {
            self.grip += u64::from(was_braking);
            let open = self.command(None, intent.clone());
            let closed = self.command(Some(self.grip), intent.clone());
            let requests = if was_braking {
                vec![(ANA, open), (ANA, closed)]
            } else {
                vec![(ANA, closed)]
            };
            let outcome = self.cycle(&requests);
            let state = outcome.state.expect("a base always has a state");
            let base = state.base.clone().expect("a base is steered");
            was_braking = base.target.is_none();
            let velocity = *self.base.0.lock();
            if is_reached(&state, velocity) {
                return state;
            }
            assert!(began.elapsed() < TIMEOUT, "{state:?}");
        }
    }
}

/// The first refusal: client, kind and reason.
fn refusal(outcome: &Outcome) -> (u64, RefusedRequest, &str) {
    match &outcome.replies[..] {
        [(client, Reply::Refused(kind, text)), ..] => (*client, *kind, text),
        other => panic!("no refusal: {other:?}"),
    }
}

fn forward(forward_m_s: f64) -> SteeringIntent {
    SteeringIntent::BaseVelocity {
        forward_m_s,
        left_m_s: 0.0,
        yaw_rad_s: 0.0,
    }
}

#[test]
fn an_operator_drives_the_base_and_the_log_replays_and_shows_the_stop() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut test = Test::new();
    let about = About {
        urdf: String::new(),
        world_from_base: Transform::identity(),
    };
    let result = test.base_loop.log_into(folder.path(), about);
    result.expect("a thread");
    let outcome = test.cycle(&[(ANA, SteeringRequest::TakeLease)]);
    assert!(outcome.begins && outcome.replies.is_empty());
    let state = test.hold_until(&forward(0.25), |_, velocity| velocity.forward_m_s == 0.25);
    assert_eq!(state.holder, Some(ANA));
    let base = state.base.expect("a base is steered");
    assert_eq!(base.target, Some([0.25, 0.0, 0.0]));
    assert_eq!(base.world_from_base, Some([0.0, 0.5, 0.0]));

    let goal = SteeringIntent::BaseGoal {
        x_m: 5.0,
        y_m: 0.0,
        heading_rad: 0.0,
    };
    let state = test.hold_until(&goal, |state, _| {
        state.limits.iter().any(|limit| limit.text.contains("goal"))
    });
    assert_eq!(state.limits[0].place, Some([5.0, 0.0, 0.0]));
    assert_eq!(state.base.and_then(|base| base.goal), Some([5.0, 0.0, 0.0]));

    let outcome = test.cycle(&[(BEN, SteeringRequest::Stop)]);
    assert!(outcome.ends_tour);
    let stop = outcome.state.and_then(|state| state.stop);
    let stop = stop.expect("it is stopped");
    assert!(stop.contains("stopped by operator 2"), "{stop}");
    let began = Instant::now();
    while *test.base.0.lock() != BaseVelocity::ZERO {
        test.cycle(&[]);
        assert!(began.elapsed() < TIMEOUT, "it does not stop");
    }
    let command = test.command(Some(999), forward(0.25));
    let outcome = test.cycle(&[(ANA, command)]);
    let (client, kind, text) = refusal(&outcome);
    assert_eq!((client, kind), (ANA, RefusedRequest::Command));
    assert!(text.contains("stopped by operator 2"), "{text}");

    test.base_loop.finish();
    drop(test);
    let files = files_of(folder.path()).expect("a log");
    let replayed = replay(&files).expect("a steering log");
    assert!(replayed.is_identical(), "{}", replayed.sentence());
    assert!(replayed.targets > 0 && replayed.damage.is_none());
    let found = incidents(&files).expect("a steering log");
    let texts: Vec<&str> = found
        .incidents
        .iter()
        .map(|incident| incident.text.as_str())
        .collect();
    let stop = found
        .incidents
        .iter()
        .find(|it| it.text.contains("stopped"));
    let at_stop = stop.and_then(|stop| stop.world_from_base);
    assert_eq!(at_stop, Some([0.0, 0.5, 0.25, 0.0, 0.0, 0.0, 1.0]));
    assert!(found.track.iter().any(|it| it.world_from_base == at_stop));
    for expected in ["operator 1 took control", "operator 2 stopped the base"] {
        assert!(texts.contains(&expected), "{texts:?}");
    }
}

#[test]
fn a_client_that_leaves_releases_the_base_and_requests_of_arms_are_refused() {
    let mut test = Test::new();
    test.cycle(&[(ANA, SteeringRequest::TakeLease)]);
    test.hold_until(&forward(0.25), |_, velocity| velocity.forward_m_s > 0.0);
    let joints = SteeringIntent::Joints { position: vec![] };
    let joints = test.command(Some(500), joints);
    let outcome = test.cycle(&[(ANA, joints)]);
    assert!(refusal(&outcome).2.contains("only the base is steered"));
    let outcome = test.cycle(&[(BEN, SteeringRequest::TakeLease)]);
    assert_eq!(refusal(&outcome).1, RefusedRequest::Lease);
    assert!(!outcome.begins && !outcome.ends_tour);
    test.cycle(&[(ANA, SteeringRequest::Disconnected)]);
    let began = Instant::now();
    loop {
        let state = test.cycle(&[]).state.expect("a state");
        let is_at_rest = test.drive.port().state().is_some_and(|it| it.is_at_rest);
        if is_at_rest && state.holder.is_none() {
            break;
        }
        assert!(began.elapsed() < TIMEOUT, "{state:?}");
    }
}

#[test]
fn nobody_can_drive_a_base_before_it_has_reported() {
    struct SilentBase;
    impl MovableBase for SilentBase {
        fn drive(&mut self, _: Stamp, _: &BaseVelocity) -> Result<(), drivers::Error> {
            Ok(())
        }
        fn report(&mut self, _: Stamp) -> BaseReport {
            BaseReport::default()
        }
    }
    let mut test = Test::new();
    test.drive = BaseDrive::start(Box::new(SilentBase), LIMITS).expect("valid limits");
    test.base_loop = SteeringLoop::of_base(
        BaseSteeringConfig::new(LIMITS),
        test.drive.port().clone(),
        TimeBase::now(),
    )
    .expect("a valid configuration");
    test.cycle(&[(ANA, SteeringRequest::TakeLease)]);
    let began = Instant::now();
    loop {
        let open = test.command(None, forward(0.1));
        test.grip += 1;
        let closed = test.command(Some(test.grip), forward(0.1));
        let state = test.cycle(&[(ANA, open), (ANA, closed)]).state;
        let state = state.expect("a state");
        assert_eq!(state.base.and_then(|base| base.target), None);
        let text = &state.limits[0].text;
        if text.contains("has reported no state") {
            break;
        }
        assert!(began.elapsed() < TIMEOUT, "{text}");
    }
}
