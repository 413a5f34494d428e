//! The loop with scripted clients, an arm's thread and a simulated clock.

use super::config;
use super::joint_map::JointMap;
use super::steering_log::{self, About};
use super::steering_loop::{Outcome, Reply, Reports, SteeredRobot, SteeringLoop};
use super::test_arm::{PANDA, START, panda};
use super::time_base::TimeBase;
use capture::config::ArmSteering;
use drivers::Error;
use drivers::motion::{ArmState, Steered, SteeringPort};
use kinematics::{Chain, Stamp, Transform, transform};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;
use steering::AnalyticScene;
use viz::{
    AppliedLimit, LimitEffect, LimitLink, PreviewGoal, PreviewRequest, PreviewVerdict,
    ReceivedRequest, RefusedRequest, SteeringCommand, SteeringIntent, SteeringRequest,
    SteeringState,
};

/// Period of the arm's thread, and of the loop in periods of the arm's thread.
const ARM_PERIOD: Duration = Duration::from_millis(1);
const ARM_STEPS_PER_CYCLE: usize = 5;
const BRAKE_FACTOR: f64 = 2.0;
const ANA: u64 = 1;
const BEN: u64 = 2;
const PAD: u64 = 10;

/// A loop, the thread of its arm, and the time.
struct Run {
    steering_loop: SteeringLoop,
    arm: Steered,
    port: SteeringPort,
    chain: Chain,
    scene: AnalyticScene,
    times: TimeBase,
    now: Stamp,
    sequence: u64,
    /// Number of the newest stop that clients have seen.
    stop_number: u64,
    /// Why the arm's thread does not follow the port, if it does not.
    fault: Option<&'static str>,
    n_recoveries: Arc<AtomicU32>,
}

impl Run {
    fn new() -> Self {
        let (chain, body, limits) = panda();
        let n_recoveries = Arc::<AtomicU32>::default();
        let recover = {
            let n_recoveries = Arc::clone(&n_recoveries);
            move || -> Result<(), Error> {
                n_recoveries.fetch_add(1, Ordering::Relaxed);
                Ok(())
            }
        };
        let port = SteeringPort::new(&limits, BRAKE_FACTOR, recover).expect("valid limits");
        let arm = Steered::new(port.clone(), &START, ARM_PERIOD).expect("in its ranges");
        let times = TimeBase::now();
        let now = times.stamp(std::time::Instant::now());
        let robot = SteeredRobot {
            body,
            joints: JointMap::new(&chain, chain.joint_names(), &[]).expect("the same joints"),
            chain: chain.clone(),
            port: port.clone(),
        };
        let first = ArmState {
            reported_at: now,
            position: START.to_vec(),
            is_at_rest: true,
            braked_motion: 0,
            stopped: None,
        };
        let config = config(&ArmSteering::default());
        let steering_loop = SteeringLoop::new(config, robot, times, &first).expect("they match");
        let mut run = Self {
            steering_loop,
            arm,
            port,
            chain,
            scene: AnalyticScene {
                solids: Vec::new(),
                seen_at: now,
                seen_radius_m: 10.0,
            },
            times,
            now,
            sequence: 0,
            stop_number: 0,
            fault: None,
            n_recoveries,
        };
        run.move_arm(1);
        run
    }

    /// Lets the arm's thread run alone, as if the loop was blocked.
    fn move_arm(&mut self, n_steps: usize) {
        for _ in 0..n_steps {
            self.now += ARM_PERIOD;
            match self.fault {
                Some(reason) => self.arm.report_stopped(self.now, reason),
                None => {
                    self.arm.step(self.now).expect("it brakes");
                }
            }
        }
    }

    /// One cycle of the loop with these requests, and of the arm's thread.
    fn cycle(&mut self, requests: Vec<(u64, SteeringRequest)>) -> Outcome {
        // The scene is always seen.
        self.scene.seen_at = self.now;
        let received: Vec<ReceivedRequest> = requests
            .into_iter()
            .map(|(client, request)| ReceivedRequest {
                client,
                received_at: self.times.instant(self.now),
                request,
            })
            .collect();
        let reports = Reports {
            arm: Some(self.steering_loop.arm().expect("a report")),
            ..Reports::default()
        };
        let outcome = self
            .steering_loop
            .cycle(self.now, &received, &reports, &self.scene);
        let state = outcome.state.as_ref();
        self.stop_number = state
            .and_then(|state| state.stop_number)
            .unwrap_or(self.stop_number);
        self.move_arm(ARM_STEPS_PER_CYCLE);
        outcome
    }

    /// A client permits motion after the newest stop that clients have seen.
    fn rearm(&self, client: u64) -> (u64, SteeringRequest) {
        let stop = self.stop_number;
        (client, SteeringRequest::Rearm { stop })
    }

    fn command(&mut self, grip: Option<u64>, intent: SteeringIntent) -> (u64, SteeringRequest) {
        self.sequence += 1;
        let command = SteeringCommand {
            device: PAD,
            sequence: self.sequence,
            captured_at: self.times.instant(self.now),
            grip,
            intent: Some(intent),
        };
        (ANA, SteeringRequest::Command(command))
    }

    /// Sends the same intent in each of some cycles. Returns the state of the last one.
    fn hold(
        &mut self,
        grip: Option<u64>,
        intent: &SteeringIntent,
        n_cycles: usize,
    ) -> SteeringState {
        let mut last = None;
        for _ in 0..n_cycles {
            let command = self.command(grip, intent.clone());
            let outcome = self.cycle(vec![command]);
            last = outcome.state;
        }
        last.expect("a state")
    }

    /// Sends the same intent with the first grip until a condition holds. Fails after 20 seconds.
    fn hold_until(
        &mut self,
        intent: &SteeringIntent,
        is_reached: impl Fn(&Self, &SteeringState) -> bool,
    ) {
        let mut last = None;
        for _ in 0..4000 {
            let state = self.hold(Some(1), intent, 1);
            if is_reached(self, &state) {
                return;
            }
            last = Some(state);
        }
        panic!("not reached: {last:?}");
    }

    /// Ana has the lease, and the open switch of her device is known.
    fn with_lease() -> Self {
        let mut run = Self::new();
        let outcome = run.cycle(vec![(ANA, SteeringRequest::TakeLease)]);
        assert!(outcome.begins && outcome.replies.is_empty(), "{outcome:?}");
        let intent = run.moved_by([0.0; 3]);
        run.hold(None, &intent, 2);
        run
    }

    fn tip(&self) -> Transform {
        let state = self.port.state().expect("a report");
        self.chain.forward(&state.position).expect("seven joints")
    }

    /// The tip's pose, moved in axes of the base.
    fn moved_by(&self, by_m: [f64; 3]) -> SteeringIntent {
        let [x, y, z] = by_m;
        let pose = nalgebra::Translation3::new(x, y, z) * self.tip();
        SteeringIntent::Pose {
            base_from_tip: transform::to_xyz_xyzw(&pose),
        }
    }

    fn is_at_rest(&self) -> bool {
        self.port.state().is_some_and(|state| state.is_at_rest)
    }

    /// Lets the loop run without requests until the arm is at rest. Fails after five seconds.
    fn wait_for_rest(&mut self) {
        for _ in 0..1000 {
            if self.is_at_rest() {
                return;
            }
            self.cycle(Vec::new());
        }
        panic!("the arm does not come to rest");
    }
}

fn limit_of(state: &SteeringState, link: LimitLink) -> &AppliedLimit {
    let found = state.limits.iter().find(|limit| limit.link == link);
    found.unwrap_or_else(|| panic!("no limit of {link:?}: {:?}", state.limits))
}

fn refusal(outcome: &Outcome) -> (RefusedRequest, String) {
    match &outcome.replies[..] {
        [(_, Reply::Refused(kind, text))] => (*kind, text.clone()),
        other => panic!("not one refusal: {other:?}"),
    }
}

#[test]
fn the_arm_follows_a_held_device_and_brakes_when_it_is_released() {
    let mut run = Run::with_lease();
    let start = run.tip();
    let goal = run.moved_by([0.0, 0.0, 0.1]);
    let state = run.hold(Some(1), &goal, 400);
    let moved_m = (run.tip().translation.vector - start.translation.vector).z;
    assert!((moved_m - 0.1).abs() < 0.003, "moved by {moved_m} m");
    assert_eq!(state.holder, Some(ANA));
    let applied = state.applied.expect("it follows the device");
    assert_eq!((applied.device, applied.sequence), (PAD, run.sequence));
    assert!(applied.applied_at >= applied.captured_at);

    // A goal far away, so that the arm moves when the switch opens.
    let far = run.moved_by([0.0, 0.3, 0.0]);
    run.hold(Some(1), &far, 100);
    assert!(!run.is_at_rest());
    let released = run.hold(None, &far, 1);
    assert_eq!(
        limit_of(&released, LimitLink::Clutch).effect,
        LimitEffect::Braked
    );
    assert!(released.applied.is_none() && released.target.is_none());
    run.wait_for_rest();
    let rest = run.tip();
    run.hold(None, &far, 100);
    assert_eq!(run.tip(), rest, "it stays where it was left");
}

#[test]
fn without_the_lease_nothing_moves_and_the_reason_is_sent() {
    let mut run = Run::new();
    let goal = run.moved_by([0.0, 0.0, 0.1]);
    let command = run.command(Some(1), goal.clone());
    let outcome = run.cycle(vec![command]);
    let (kind, text) = refusal(&outcome);
    assert_eq!(kind, RefusedRequest::Command);
    assert!(text.contains("take control first"), "{text}");
    assert!(!outcome.begins);

    let mut run = Run::with_lease();
    let outcome = run.cycle(vec![(BEN, SteeringRequest::TakeLease)]);
    assert!(refusal(&outcome).1.contains("operator 1 has control"));
    assert!(!outcome.begins, "the arm was taken over before");
    // The connection of the holder ends, and another operator can go on.
    run.hold(Some(1), &goal, 40);
    let outcome = run.cycle(vec![(ANA, SteeringRequest::Disconnected)]);
    let state = outcome.state.expect("a state");
    assert_eq!(state.holder, None);
    run.wait_for_rest();
    let outcome = run.cycle(vec![(BEN, SteeringRequest::TakeLease)]);
    assert_eq!(outcome.state.and_then(|state| state.holder), Some(BEN));
}

#[test]
fn the_arm_brakes_by_itself_while_the_loop_is_blocked_and_needs_a_new_grip() {
    let mut run = Run::with_lease();
    let far = run.moved_by([0.0, 0.3, 0.0]);
    run.hold(Some(1), &far, 100);
    assert!(!run.is_at_rest());
    run.move_arm(2000);
    assert!(run.is_at_rest(), "the target has expired");
    let rest = run.tip();
    // The loop continues, and the operator has held the switch all the time.
    let state = run.hold(Some(1), &far, 100);
    assert_eq!(run.tip(), rest);
    assert!(state.target.is_none());
    // After a release and a new grip, the arm moves again.
    run.hold(None, &far, 2);
    run.hold(Some(2), &far, 100);
    let moved_m = (run.tip().translation.vector - rest.translation.vector).norm();
    assert!(moved_m > 0.01, "{moved_m} m");
}

#[test]
fn a_plan_that_fails_is_refused_and_the_next_one_is_followed() {
    let mut run = Run::with_lease();
    let out_of_reach = run.moved_by([0.0, 0.0, 5.0]);
    run.hold_until(&out_of_reach, |_, state| {
        let mut limits = state.limits.iter();
        limits.any(|limit| limit.link == LimitLink::Limits && limit.effect == LimitEffect::Refused)
    });
    let stretched = run.tip().translation.vector;
    let down = run.moved_by([0.0, 0.0, -0.1]);
    run.hold_until(&down, |run, _| {
        (run.tip().translation.vector - stretched).z < -0.05
    });
}

#[test]
fn everybody_may_stop_the_arm_and_only_the_holder_permits_motion() {
    let mut run = Run::with_lease();
    let far = run.moved_by([0.0, 0.3, 0.0]);
    run.hold(Some(1), &far, 100);
    let outcome = run.cycle(vec![(BEN, SteeringRequest::Stop)]);
    let stop = outcome.state.and_then(|state| state.stop);
    assert!(stop.is_some_and(|stop| stop.contains("stopped by operator 2")));
    run.wait_for_rest();
    let rest = run.tip();
    run.hold(None, &far, 2);
    run.hold(Some(2), &far, 50);
    assert_eq!(run.tip(), rest, "it stays stopped");
    let rearm = run.rearm(BEN);
    let outcome = run.cycle(vec![rearm]);
    assert_eq!(refusal(&outcome).0, RefusedRequest::Rearm);
    let rearm = run.rearm(ANA);
    let outcome = run.cycle(vec![rearm]);
    assert!(outcome.replies.is_empty(), "{outcome:?}");
    run.hold(None, &far, 2);
    run.hold(Some(3), &far, 100);
    assert_ne!(run.tip(), rest);
}

#[test]
fn an_arm_with_a_fault_is_recovered_only_when_the_holder_permits_motion() {
    let mut run = Run::with_lease();
    run.fault = Some("a motor is too hot");
    run.move_arm(1);
    let state = run.cycle(Vec::new()).state.expect("a state");
    assert!(state.stop.is_some_and(|stop| stop.contains("too hot")));
    assert_eq!(
        limit_of(
            &run.cycle(Vec::new()).state.expect("a state"),
            LimitLink::Arm
        )
        .effect,
        LimitEffect::Braked
    );
    assert_eq!(run.n_recoveries.load(Ordering::Relaxed), 0);
    let rearm = run.rearm(ANA);
    let outcome = run.cycle(vec![rearm]);
    assert!(outcome.replies.is_empty(), "{outcome:?}");
    assert!(outcome.state.is_some_and(|state| state.is_recovering));
    // The recovery runs on a separate thread, so the test waits for it in real time.
    while run.n_recoveries.load(Ordering::Relaxed) == 0 {
        std::thread::yield_now();
    }
    run.fault = None;
    let until = std::time::Instant::now() + Duration::from_secs(60);
    loop {
        let state = run.cycle(vec![(ANA, SteeringRequest::RenewLease)]).state;
        if let Some(state) = state.filter(|state| state.stop.is_none()) {
            assert!(!state.is_recovering, "it has ended");
            break;
        }
        assert!(std::time::Instant::now() < until, "motion is not permitted");
        std::thread::yield_now();
    }
}

/// The tour of a simulated arm ends, see `capture::open::SteeredArm::begin`.
#[test]
fn a_stop_before_the_first_lease_ends_the_tour() {
    let mut run = Run::new();
    assert!(!run.cycle(Vec::new()).ends_tour);
    let outcome = run.cycle(vec![(BEN, SteeringRequest::Stop)]);
    assert!(outcome.ends_tour && !outcome.begins, "{outcome:?}");
    let state = outcome.state.expect("a state");
    assert!(state.stop.is_some_and(|stop| stop.contains("operator 2")));
    // The first operator takes the arm over afterward, and must permit motion.
    let outcome = run.cycle(vec![(ANA, SteeringRequest::TakeLease)]);
    assert!(outcome.begins);
    assert!(outcome.state.is_some_and(|state| state.stop.is_some()));
}

#[test]
fn a_permission_from_before_a_newer_stop_does_not_undo_it() {
    let mut run = Run::with_lease();
    let stopped = run.cycle(vec![(ANA, SteeringRequest::Stop)]);
    let first = stopped.state.and_then(|state| state.stop_number);
    assert_eq!(first, Some(1));
    let permission = run.rearm(ANA);
    // The permission is on its way while Ben stops the arm.
    let outcome = run.cycle(vec![(BEN, SteeringRequest::Stop), permission]);
    let (kind, text) = refusal(&outcome);
    assert_eq!(kind, RefusedRequest::Rearm);
    assert!(text.contains("stop 1") && text.contains("stop 2"), "{text}");
    let state = outcome.state.expect("a state");
    assert!(state.stop.is_some());
    assert_eq!(state.stop_number, Some(2));
    let permission = run.rearm(ANA);
    let outcome = run.cycle(vec![permission.clone()]);
    assert!(outcome.replies.is_empty(), "{outcome:?}");
    let state = outcome.state.expect("a state");
    assert_eq!((state.stop, state.stop_number), (None, None));
    // The same message again, after a third stop.
    let outcome = run.cycle(vec![(BEN, SteeringRequest::Stop), permission]);
    assert_eq!(refusal(&outcome).0, RefusedRequest::Rearm);
}

#[test]
fn a_permission_from_before_a_fault_of_the_arm_does_not_undo_it() {
    let mut run = Run::with_lease();
    run.cycle(vec![(BEN, SteeringRequest::Stop)]);
    let permission = run.rearm(ANA);
    run.fault = Some("a motor is too hot");
    run.move_arm(1);
    let state = run.cycle(Vec::new()).state.expect("a state");
    assert_eq!(state.stop_number, Some(2));
    // A fault that lasts is one stop.
    let state = run.cycle(Vec::new()).state.expect("a state");
    assert_eq!(state.stop_number, Some(2));
    let outcome = run.cycle(vec![permission]);
    assert_eq!(refusal(&outcome).0, RefusedRequest::Rearm);
    assert_eq!(run.n_recoveries.load(Ordering::Relaxed), 0);
}

#[test]
fn a_stop_during_a_recovery_is_not_undone_by_its_end() {
    let mut run = Run::with_lease();
    run.fault = Some("a motor is too hot");
    run.move_arm(1);
    run.cycle(Vec::new());
    let rearm = run.rearm(ANA);
    run.cycle(vec![rearm]);
    let outcome = run.cycle(vec![(BEN, SteeringRequest::Stop)]);
    assert!(outcome.replies.is_empty(), "{outcome:?}");
    let state = outcome.state.expect("a state");
    assert!(state.is_recovering);
    let stop = state.stop.expect("the arm is stopped");
    assert!(
        stop.contains("too hot") && stop.contains("since then: stopped by operator 2"),
        "{stop}"
    );
    // The recovery runs on a separate thread, so the test waits for it in real time.
    let until = std::time::Instant::now() + Duration::from_secs(60);
    let refused = loop {
        assert!(std::time::Instant::now() < until, "the recovery has no end");
        if run.n_recoveries.load(Ordering::Relaxed) > 0 {
            run.fault = None;
        }
        let outcome = run.cycle(vec![(ANA, SteeringRequest::RenewLease)]);
        let stop = outcome.state.as_ref().and_then(|state| state.stop.as_ref());
        assert!(stop.is_some(), "nobody has permitted motion since the stop");
        if !outcome.replies.is_empty() {
            break refusal(&outcome);
        }
        std::thread::yield_now();
    };
    assert_eq!(refused.0, RefusedRequest::Rearm);
    assert!(refused.1.contains("permit motion again"), "{}", refused.1);
    let rearm = run.rearm(ANA);
    let outcome = run.cycle(vec![rearm]);
    assert!(outcome.replies.is_empty(), "{outcome:?}");
    assert!(outcome.state.is_some_and(|state| state.stop.is_none()));
}

#[test]
fn a_command_that_waited_in_the_inbox_does_not_look_fresh() {
    let mut run = Run::with_lease();
    let far = run.moved_by([0.0, 0.3, 0.0]);
    run.hold(Some(1), &far, 100);
    let (client, request) = run.command(Some(1), far);
    let received = ReceivedRequest {
        client,
        received_at: run.times.instant(run.now),
        request,
    };
    let received_at = run.now;
    // The loop is late by less than the time after which the arm itself brakes.
    run.move_arm(80);
    run.scene.seen_at = run.now;
    let reports = Reports {
        arm: Some(run.steering_loop.arm().expect("a report")),
        ..Reports::default()
    };
    let outcome = run
        .steering_loop
        .cycle(run.now, &[received], &reports, &run.scene);
    let followed = outcome.state.expect("a state");
    assert!(followed.target.is_some(), "{:?}", followed.limits);
    let mut braked = None;
    while braked.is_none() {
        run.move_arm(ARM_STEPS_PER_CYCLE);
        let state = run.cycle(Vec::new()).state.expect("a state");
        braked = state.target.is_none().then_some(state);
    }
    let braked = braked.expect("the loop has ended");
    let text = &limit_of(&braked, LimitLink::Clutch).text;
    assert!(text.contains("was silent"), "{text}");
    let silent_secs = run.now.secs_since(received_at);
    assert!(silent_secs < 0.15, "{silent_secs} s");
}

#[test]
fn previews_wait_while_the_arm_follows_an_operator() {
    let mut run = Run::with_lease();
    let far = run.moved_by([0.0, 0.3, 0.0]);
    run.hold(Some(1), &far, 50);
    let goal = PreviewGoal::Joints {
        position: START.to_vec(),
    };
    let request = SteeringRequest::Preview(PreviewRequest { id: 7, goal });
    let held = run.command(Some(1), far.clone());
    let outcome = run.cycle(vec![(BEN, request), held]);
    assert!(outcome.replies.is_empty(), "{outcome:?}");
    let released = run.command(None, far);
    let outcome = run.cycle(vec![released]);
    assert!(
        matches!(&outcome.replies[..], [(BEN, Reply::Preview(7, _))]),
        "{outcome:?}"
    );
}

#[test]
fn goals_are_judged_without_moving_the_arm() {
    let mut run = Run::new();
    let rest = run.tip();
    let ask = |run: &mut Run, goal: PreviewGoal| {
        let request = PreviewRequest { id: 7, goal };
        let outcome = run.cycle(vec![(BEN, SteeringRequest::Preview(request))]);
        match &outcome.replies[..] {
            [(BEN, Reply::Preview(7, preview))] => preview.clone(),
            other => panic!("not one preview: {other:?}"),
        }
    };
    let pose = |by_m: [f64; 3]| PreviewGoal::Pose {
        base_from_tip: transform::to_xyz_xyzw(
            &(nalgebra::Translation3::new(by_m[0], by_m[1], by_m[2]) * rest),
        ),
    };
    let near = ask(&mut run, pose([0.0, 0.1, 0.05]));
    assert_eq!(near.verdict, PreviewVerdict::Reachable, "{}", near.text);
    let reached = run
        .chain
        .forward(&near.position.expect("a posture"))
        .expect("seven joints");
    let gap_m = (reached.translation.vector - rest.translation.vector).norm();
    assert!((gap_m - 0.1_f64.hypot(0.05)).abs() < 1e-3, "{gap_m} m");
    let far = ask(&mut run, pose([0.0, 0.0, 5.0]));
    assert_eq!(far.verdict, PreviewVerdict::Unreachable, "{}", far.text);
    let mut beyond = START.to_vec();
    beyond[3] = 1.0;
    let beyond = ask(&mut run, PreviewGoal::Joints { position: beyond });
    assert_eq!(beyond.verdict, PreviewVerdict::Limits);
    assert!(beyond.text.contains("panda_joint4"), "{}", beyond.text);
    // Nothing was ever seen.
    run.scene.seen_radius_m = 0.0;
    let unseen = ask(
        &mut run,
        PreviewGoal::Joints {
            position: START.to_vec(),
        },
    );
    assert_eq!(unseen.verdict, PreviewVerdict::NeverSeen, "{}", unseen.text);
    assert!(unseen.place.is_some());
    assert_eq!(run.tip(), rest);
}

#[test]
fn log_of_the_loop_has_its_decisions_and_what_the_holder_of_the_lease_sees() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut run = Run::new();
    let about = About {
        urdf: PANDA.to_owned(),
        world_from_base: Transform::identity(),
    };
    run.steering_loop
        .log_into(folder.path(), about)
        .expect("a thread");
    run.cycle(vec![(ANA, SteeringRequest::TakeLease)]);
    let [of_ana, of_ben] = [1.0, 2.0].map(|x| [x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    for (client, world_from_camera) in [(ANA, of_ana), (BEN, of_ben)] {
        let outcome = run.cycle(vec![(client, SteeringRequest::View { world_from_camera })]);
        assert!(outcome.replies.is_empty(), "{outcome:?}");
    }
    let down = run.moved_by([0.0, 0.0, -0.05]);
    run.hold(None, &down, 2);
    run.hold(Some(1), &down, 40);
    run.cycle(vec![(BEN, SteeringRequest::Stop)]);
    run.wait_for_rest();
    drop(run);
    let files = steering_log::files_of(folder.path()).expect("a log");
    let replayed = steering_log::replay(&files).expect("a log");
    assert!(replayed.is_identical(), "{}", replayed.sentence());
    assert_eq!(replayed.targets, 40);
    let found = steering_log::incidents(&files).expect("a log").incidents;
    let stop = found.back().expect("a stop");
    assert_eq!(
        (&*stop.text, stop.view),
        ("operator 2 stopped the arm", Some(of_ana))
    );
}
