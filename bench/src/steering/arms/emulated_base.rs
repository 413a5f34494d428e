//! The driver of bases over UDP with an emulated controller, which ends velocities that expire.

use super::super::trace::Recorder;
use super::simulated_base::{robot_of, setpoint_after};
use super::{ArmKind, ArmThread, BenchRobot, Emulated};
use anyhow::{Context, Result};
use drivers::clock;
use drivers::udp::{EmulatedBase, UdpDrivenBase};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Time between two cycles of the controller.
const PERIOD: Duration = Duration::from_millis(1);

/// Starts the controller. The velocities of the base are recorded.
pub(super) fn emulate() -> Result<Emulated> {
    let controller = EmulatedBase::start().context("cannot emulate the controller of a base")?;
    let address = controller
        .address()
        .context("the socket of the emulated base has no address")?;
    let recorder = Recorder::default();
    let thread = ArmThread::spawn({
        let recorder = recorder.clone();
        move |must_stop| control(controller, &recorder, must_stop)
    })?;
    Ok(Emulated {
        address: address.to_string(),
        recorder,
        _device: Box::new(thread),
    })
}

/// Opens the base of a controller.
pub(super) fn connect(address: &str) -> Result<BenchRobot> {
    let address = address.parse().context("the address of the base")?;
    // Two starts never have the same time.
    let session = clock::now().0.unsigned_abs();
    let base = UdpDrivenBase::open(address, session)?;
    robot_of(ArmKind::UdpBase, Box::new(base))
}

/// Runs the controller.
fn control(mut controller: EmulatedBase, recorder: &Recorder, must_stop: &AtomicBool) {
    while !must_stop.load(Ordering::Relaxed) {
        let now = clock::now();
        controller.cycle(now.0);
        let setpoint = setpoint_after(recorder.newest().as_ref(), now, controller.velocity());
        recorder.push(now, setpoint);
        std::thread::sleep(PERIOD);
    }
}
