//! Conversations of the driver with an emulated motor of each family, compared byte by byte with
//! `transcript.txt` of the family's folder.
//!
//! In these files, `>` is a frame to the motor, `<` a frame from it, and `=` a result of the
//! driver. After an intended change of a protocol, replace the file with the text that the test
//! prints.

use super::emulated::EmulatedMotor;
use super::family::{Health, LIMITS};
use super::frame_io::{BusEvent, FrameIo};
use super::fuzz::motors;
use super::motor::Motor;
use super::movable_motor::MovableMotor;
use super::odrive::{self, Endpoints, emulated};
use super::plan::check_motor;
use super::watchdog::WatchdogPlan;
use super::{Gains, MotorConfig};
use crate::Error;
use crate::motion::{MotionLimits, OnLoss};
use crate::wire::can::{Frame, canopen};
use kinematics::Stamp;
use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::fmt::Write;
use std::time::Duration;

/// Cycle period and timeout of the watchdog.
const PERIOD: Duration = Duration::from_millis(5);
const TIMEOUT: Duration = Duration::from_millis(100);

/// A bus with one emulated motor. A millisecond passes whenever nothing is waiting to be received.
struct TestBus {
    motor: RefCell<EmulatedMotor>,
    now: Cell<Stamp>,
    waiting: RefCell<VecDeque<Frame>>,
    /// A frame that another master sends every millisecond.
    other_master: Option<Frame>,
    /// Whether frames and readings are left out of the transcript.
    is_quiet: Cell<bool>,
    transcript: RefCell<String>,
}

impl TestBus {
    fn new(config: &MotorConfig) -> Self {
        let motor = RefCell::new(EmulatedMotor::new(&*config.protocol, LIMITS));
        let (waiting, is_quiet, transcript) =
            (RefCell::default(), Cell::new(false), RefCell::default());
        Self {
            motor,
            now: Cell::new(Stamp(0)),
            waiting,
            other_master: None,
            is_quiet,
            transcript,
        }
    }

    fn note(&self, line: &str) {
        writeln!(self.transcript.borrow_mut(), "{line}").unwrap();
    }

    /// Adds a frame or reading to the transcript, unless they are left out.
    fn note_often(&self, line: &str) {
        if !self.is_quiet.get() {
            self.note(line);
        }
    }

    fn note_error(&self, result: Result<(), Error>) {
        if let Err(error) = result {
            self.note(&format!("= {error}"));
        }
    }

    fn enqueue(&self, frames: Vec<Frame>) {
        frames
            .iter()
            .for_each(|frame| self.note_often(&format!("< {}", text_of(frame))));
        self.waiting.borrow_mut().extend(frames);
    }
}

impl FrameIo for TestBus {
    fn interface(&self) -> &str {
        "test0"
    }

    fn send(&self, frame: &Frame) -> Result<bool, Error> {
        self.note_often(&format!("> {}", text_of(frame)));
        let answers = self.motor.borrow_mut().take(frame).unwrap();
        self.enqueue(answers);
        Ok(true)
    }

    fn receive(&self, _timeout: Duration) -> Result<Option<(Stamp, BusEvent)>, Error> {
        if self.waiting.borrow().is_empty() {
            self.now.set(self.now.get() + Duration::from_millis(1));
            let reports = self.motor.borrow_mut().report(self.now.get()).unwrap();
            self.enqueue(reports);
            if let Some(frame) = &self.other_master {
                let answers = self.motor.borrow_mut().take(frame).unwrap();
                self.enqueue(answers);
            }
        }
        Ok(self
            .waiting
            .borrow_mut()
            .pop_front()
            .map(|frame| (self.now.get(), BusEvent::Frame(frame))))
    }
}

fn text_of(frame: &Frame) -> String {
    let id = if frame.id().is_extended() {
        format!("{:08X}", frame.id().value())
    } else {
        format!("{:03X}", frame.id().value())
    };
    let bytes: Vec<String> = frame
        .data()
        .iter()
        .map(|byte| format!("{byte:02X}"))
        .collect();
    format!(
        "{id}{} {}",
        if frame.is_remote() { " remote" } else { "" },
        bytes.join(" ")
    )
}

/// Finds a motor as a read-only arm does, and polls it.
fn reading(config: &MotorConfig) -> String {
    let bus = TestBus {
        other_master: config.protocol.family().fuzzing().other_master,
        ..TestBus::new(config)
    };
    let motor = Motor::set_up(&bus, config).unwrap();
    let (answer, rate_hz) = motor.protocol().typical_answer();
    bus.note(&format!(
        "= answers like {} at {rate_hz:?} Hz",
        text_of(&answer)
    ));
    for _ in 0..3 {
        motor
            .protocol()
            .poll_frame()
            .iter()
            .for_each(|frame| drop(bus.send(frame)));
        if motor.protocol().canopen_node().is_some() {
            bus.send(&canopen::encode_sync()).unwrap();
        }
        for _ in 0..12 {
            if let Ok(Some((_, BusEvent::Frame(frame)))) = bus.receive(PERIOD)
                && let Some(reading) = motor.read(&frame)
            {
                bus.note(&format!("= {reading:?}"));
            }
        }
    }
    bus.transcript.into_inner()
}

fn plan(on_loss: OnLoss) -> WatchdogPlan {
    let host = canopen::Node::new(127).unwrap();
    WatchdogPlan {
        on_loss,
        timeout: TIMEOUT,
        accept_no_watchdog: true,
        host,
        period: PERIOD,
    }
}

/// Runs cycles of a moving arm. The transcript contains frames and readings of the first two
/// cycles, and all changes of the motor's health.
fn cycles(bus: &TestBus, motor: &mut MovableMotor, n: usize, position_rad: Option<f64>) {
    for cycle in 0..n {
        bus.is_quiet.set(cycle >= 2);
        if let Some(position_rad) = position_rad {
            bus.send(&motor.command(position_rad, 0.125).unwrap())
                .unwrap();
            if motor.motor().protocol().canopen_node().is_some() {
                bus.send(&canopen::encode_heartbeat(
                    canopen::Node::new(127).unwrap(),
                    canopen::NodeState::Operational,
                ))
                .unwrap();
                bus.send(&canopen::encode_sync()).unwrap();
            }
        }
        let end = bus.now.get() + PERIOD;
        while bus.now.get() < end {
            let Some((_, BusEvent::Frame(frame))) = bus.receive(PERIOD).unwrap() else {
                continue;
            };
            let before = motor.health().cloned();
            let reading = motor.process_frame(&frame);
            reading
                .iter()
                .for_each(|reading| bus.note_often(&format!("= {reading:?}")));
            if motor.health() != before.as_ref() {
                bus.note(&format!("= {:?}", motor.health()));
            }
        }
    }
    bus.is_quiet.set(false);
    let emulated = bus.motor.borrow();
    bus.note(&format!(
        "= {:?} {:.6?} {:?}",
        emulated.state(),
        emulated.motion(),
        emulated.target()
    ));
}

fn start(bus: &TestBus, config: &MotorConfig, plan: &WatchdogPlan) -> Result<MovableMotor, Error> {
    bus.note("# prepare");
    let mut motor = MovableMotor::prepare(bus, config, plan)?;
    bus.note("# poll");
    motor
        .poll_frame()
        .iter()
        .for_each(|frame| drop(bus.send(frame)));
    cycles(bus, &mut motor, 1, None);
    motor.clear_health();
    bus.note("# enable");
    motor
        .enable()
        .unwrap()
        .iter()
        .for_each(|frame| drop(bus.send(frame)));
    cycles(bus, &mut motor, 25, Some(0.375));
    Ok(motor)
}

/// Moves a motor, lets its watchdog expire, moves it again, and lets it fail.
fn moving(config: &MotorConfig, plan: &WatchdogPlan) -> String {
    let bus = TestBus::new(config);
    if let Err(error) = check_motor(plan, config, "test0") {
        return format!("= {error}\n");
    }
    let traffic = config.protocol.traffic();
    traffic
        .cycle_frames
        .iter()
        .for_each(|frame| bus.note(&format!("= in each cycle {}", text_of(frame))));
    traffic
        .unsolicited
        .iter()
        .for_each(|(frame, rate_hz)| bus.note(&format!("= {} at {rate_hz} Hz", text_of(frame))));
    let run = || {
        let mut motor = start(&bus, config, plan)?;
        let wide = MotionLimits {
            position: [-1e9, f64::INFINITY],
            velocity: 1e9,
            acceleration: 1.0,
            jerk: 1.0,
        };
        bus.note(&format!("= {:?}", motor.limits(&wide)));
        bus.note(&format!(
            "= silent for at most {:?}",
            motor.max_silence(Duration::from_millis(40))
        ));
        bus.note("# commands stop");
        cycles(&bus, &mut motor, 40, None);
        let mut motor = start(&bus, config, plan)?;
        bus.note("# fail");
        bus.motor.borrow_mut().fail();
        cycles(&bus, &mut motor, 25, Some(0.5));
        let mut motor = start(&bus, config, plan)?;
        assert!(
            matches!(motor.health(), Some(Health::Enabled)),
            "{:?}",
            motor.health()
        );
        for on_loss in [OnLoss::Hold, OnLoss::Damp, OnLoss::Release] {
            bus.note(&format!("# shut down: {}", on_loss.name()));
            bus.send(&motor.shutdown(on_loss, 0.375).unwrap()).unwrap();
            cycles(&bus, &mut motor, 4, None);
        }
        Ok(())
    };
    bus.note_error(run());
    bus.transcript.into_inner()
}

/// The last line of a failed preparation.
fn rejected(
    config: &MotorConfig,
    plan: &WatchdogPlan,
    change: impl Fn(&mut EmulatedMotor),
) -> String {
    let bus = TestBus::new(config);
    change(&mut bus.motor.borrow_mut());
    match MovableMotor::prepare(&bus, config, plan) {
        Ok(_) => "= accepted\n".to_owned(),
        Err(error) => format!("= {error}\n"),
    }
}

/// A motor that sends nothing.
struct SilentBus;

impl FrameIo for SilentBus {
    fn interface(&self) -> &str {
        "test0"
    }

    fn send(&self, _frame: &Frame) -> Result<bool, Error> {
        Ok(true)
    }

    fn receive(&self, _timeout: Duration) -> Result<Option<(Stamp, BusEvent)>, Error> {
        std::thread::sleep(Duration::from_millis(1));
        Ok(None)
    }
}

/// The motor with these endpoints, if it is an `ODrive` axis; otherwise, the same motor.
fn with_endpoints(config: &MotorConfig, endpoints: Option<&Endpoints>) -> MotorConfig {
    let mut config = config.clone();
    odrive::set_endpoints(&mut config.protocol, endpoints);
    config
}

fn conversation(config: &MotorConfig) -> String {
    let gains = Some(Gains {
        stiffness_nm_rad: 60.0,
        damping_nm_s_rad: 4.0,
    });
    let without_endpoints = &MotorConfig {
        gains,
        ..with_endpoints(config, None)
    };
    let config = &with_endpoints(without_endpoints, Some(&emulated::endpoints()));
    let silence = Motor::set_up(&SilentBus, config).unwrap_err();
    let mut text = format!("## silent\n= {silence}\n## reading\n{}", reading(config));
    for on_loss in [OnLoss::Hold, OnLoss::Damp, OnLoss::Release] {
        let [moved, moved_without] =
            [config, without_endpoints].map(|config| moving(config, &plan(on_loss)));
        write!(text, "## moving, {}\n{moved}", on_loss.name()).unwrap();
        if moved_without != moved {
            write!(
                text,
                "## moving without endpoints, {}\n{moved_without}",
                on_loss.name()
            )
            .unwrap();
        }
    }
    text += "## rejected\n";
    let strict = WatchdogPlan {
        accept_no_watchdog: false,
        ..plan(OnLoss::Release)
    };
    text += &check_motor(&strict, without_endpoints, "test0")
        .map_or_else(|error| format!("= {error}\n"), |()| String::new());
    let without_gains = MotorConfig {
        gains: None,
        ..without_endpoints.clone()
    };
    text += &check_motor(&strict, &without_gains, "test0")
        .map_or_else(|error| format!("= {error}\n"), |()| String::new());
    let lenient = plan(OnLoss::Release);
    text += &rejected(config, &lenient, EmulatedMotor::ignore_timeout);
    let older_endpoints = Endpoints {
        firmware: "0.6.8".to_owned(),
        ..emulated::endpoints()
    };
    let with_older = with_endpoints(config, Some(&older_endpoints));
    text += &rejected(&with_older, &lenient, |_| {});
    let gains = Some(Gains {
        stiffness_nm_rad: 3e4,
        damping_nm_s_rad: 4.0,
    });
    text += &rejected(
        &MotorConfig {
            gains,
            ..config.clone()
        },
        &lenient,
        |_| {},
    );
    text
}

#[test]
fn conversations_match_transcripts() {
    for config in motors() {
        let family = config.protocol.family();
        let (text, expected) = (conversation(&config), family.fuzzing().transcript);
        for (number, (got, expected)) in (1..).zip(text.lines().zip(expected.lines())) {
            assert_eq!(
                got,
                expected,
                "line {number} of transcript.txt of {}; all lines:\n{text}",
                family.name()
            );
        }
        assert_eq!(
            text.lines().count(),
            expected.lines().count(),
            "lines of transcript.txt of {}",
            family.name()
        );
    }
}
