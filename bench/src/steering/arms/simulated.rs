//! A simulated arm without a scene: the controller of simulated arms after their tour, with a
//! setpoint per millisecond on a separate thread.

use super::super::trace::Recorder;
use super::{
    ArmKind, ArmThread, BRAKE_FACTOR, BenchArm, BenchRobot, Moved, Period, brake_limits,
    motion_limits, robot,
};
use anyhow::Result;
use drivers::clock;
use drivers::motion::{Setpoint, Steered, SteeringPort};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Time between two setpoints.
const PERIOD: Duration = Duration::from_millis(1);
/// A posture of a Panda with space around it, radians.
const START_RAD: [f64; 7] = [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];

pub(super) fn start() -> Result<BenchRobot> {
    let (robot, chain) = robot("panda")?;
    let limits = motion_limits(&chain);
    // A simulated arm has no fault from which it would have to recover.
    let port = SteeringPort::new(&limits, BRAKE_FACTOR, || Ok(()))?;
    let steered = Steered::new(port.clone(), &START_RAD, PERIOD)?;
    let recorder = Recorder::default();
    let thread = ArmThread::spawn({
        let recorder = recorder.clone();
        move |must_stop| follow(steered, &recorder, must_stop)
    })?;
    Ok(BenchRobot {
        kind: ArmKind::Simulated,
        brake_limits: port.brake_limits().to_vec(),
        recorder,
        checked_limits: brake_limits(&limits, BRAKE_FACTOR),
        moved: Moved::Arm(BenchArm {
            robot,
            chain,
            start: START_RAD.to_vec(),
            port,
        }),
        period: Period::Constant(PERIOD),
        running: Box::new(thread),
    })
}

/// Follows the port in real time.
fn follow(mut steered: Steered, recorder: &Recorder, must_stop: &AtomicBool) {
    let mut due = Instant::now();
    while !must_stop.load(Ordering::Relaxed) {
        let now = clock::now();
        match steered.step(now) {
            Ok(setpoint) => recorder.push(now, setpoint),
            Err(error) => {
                // Only a simulated arm can stop at once, which then shows as an exceeded limit.
                if let Some(last) = recorder.newest() {
                    recorder.push(now, Setpoint::at_rest(last.setpoint.position));
                }
                steered.report_stopped(now, &error.to_string());
                return;
            }
        }
        due += PERIOD;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
}
