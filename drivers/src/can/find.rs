//! Finds motors on a bus. Nothing moves, and no setting is changed.

use super::FAMILIES;
use super::family::MotorFamily;
use super::frame_io::{BusEvent, FrameIo};
use super::settings::MotorSettings;
use crate::wire::can::Frame;
use crate::{Error, clock};
use std::time::Duration;

/// How long [`motors_on`] waits for frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SearchTimes {
    /// Time for frames that motors send without being asked.
    pub listen: Duration,
    /// Time for the last answers to requests.
    pub answer: Duration,
}

impl Default for SearchTimes {
    /// A CANopen drive sends a heartbeat every 500 ms or more often, and an answer takes some
    /// milliseconds.
    fn default() -> Self {
        Self {
            listen: Duration::from_millis(1200),
            answer: Duration::from_millis(200),
        }
    }
}

/// A motor that was found.
#[derive(Clone, Debug)]
pub struct FoundMotor {
    /// Its family.
    pub family: &'static dyn MotorFamily,
    /// Its ID, and other settings that it reports. Settings that a motor does not report, such as
    /// its model, are absent.
    pub settings: MotorSettings,
}

impl PartialEq for FoundMotor {
    fn eq(&self, other: &Self) -> bool {
        self.family.name() == other.family.name() && self.settings == other.settings
    }
}

/// The motors on a bus, ordered by family and ID. First listens, and then asks motors of the
/// families whose requests have no effect besides an answer.
///
/// The requests end as soon as no other node acknowledges them, because the controller would
/// repeat the first one without end.
///
/// # Errors
/// If the bus cannot be read or written.
pub fn motors_on(bus: &dyn FrameIo, times: SearchTimes) -> Result<Vec<FoundMotor>, Error> {
    let mut found = Vec::new();
    let mut is_acknowledged = receive_for(bus, times.listen, &mut found)?;
    for request in FAMILIES
        .iter()
        .flat_map(|family| family.identification_requests())
    {
        if !is_acknowledged || !bus.send(&request)? {
            break;
        }
        is_acknowledged = receive_for(bus, Duration::ZERO, &mut found)?;
    }
    receive_for(bus, times.answer, &mut found)?;
    found.sort_by_key(|motor| {
        let is_same = |family: &&dyn MotorFamily| family.name() == motor.family.name();
        (FAMILIES.iter().position(is_same), motor.settings.id)
    });
    Ok(found)
}

/// Receives frames for a time, at least all that are waiting. Returns false if a frame of this
/// computer was not acknowledged.
fn receive_for(
    bus: &dyn FrameIo,
    time: Duration,
    found: &mut Vec<FoundMotor>,
) -> Result<bool, Error> {
    let deadline = clock::now() + time;
    loop {
        let remaining = deadline.duration_since(clock::now());
        match bus.receive(remaining)? {
            Some((_, BusEvent::Frame(frame))) => found.extend(new_motor(&frame, found)),
            Some((_, BusEvent::Errors(errors)))
                if errors.n_unacknowledged + errors.n_passive + errors.n_bus_off > 0 =>
            {
                return Ok(false);
            }
            Some((_, BusEvent::Errors(_))) => {}
            None if remaining.is_zero() => return Ok(true),
            None => {}
        }
    }
}

/// The motor that a frame identifies, unless it is known.
fn new_motor(frame: &Frame, known: &[FoundMotor]) -> Option<FoundMotor> {
    let found = FAMILIES.iter().find_map(|family| {
        let settings = family.identify(frame)?;
        Some(FoundMotor {
            family: *family,
            settings,
        })
    })?;
    let is_same = |motor: &FoundMotor| {
        motor.family.name() == found.family.name() && motor.settings.id == found.settings.id
    };
    (!known.iter().any(is_same)).then_some(found)
}

#[cfg(all(test, feature = "emulation"))]
mod tests {
    use super::*;
    use crate::can::emulated::EmulatedMotor;
    use crate::can::frame_io::WireErrors;
    use crate::can::{MotorProtocol, SettingValue};
    use crate::wire::can::mit::Limits;
    use kinematics::Stamp;
    use std::cell::RefCell;
    use std::collections::VecDeque;
    use std::sync::Arc;

    const TIMES: SearchTimes = SearchTimes {
        listen: Duration::from_millis(20),
        answer: Duration::from_millis(20),
    };

    /// A bus with emulated motors. A millisecond of simulated time passes whenever nothing is
    /// waiting.
    struct MotorBus {
        motors: RefCell<Vec<EmulatedMotor>>,
        waiting: RefCell<VecDeque<Frame>>,
        now: RefCell<Stamp>,
        sent: RefCell<Vec<Frame>>,
    }

    impl MotorBus {
        fn with(motors: &[Arc<dyn MotorProtocol>]) -> Self {
            let limits = Limits::of(12.5, 30.0, 10.0);
            let emulated = motors
                .iter()
                .map(|motor| EmulatedMotor::new(&**motor, limits));
            Self {
                motors: RefCell::new(emulated.collect()),
                waiting: RefCell::default(),
                now: RefCell::new(Stamp(0)),
                sent: RefCell::default(),
            }
        }
    }

    impl FrameIo for MotorBus {
        fn interface(&self) -> &str {
            "can0"
        }

        fn send(&self, frame: &Frame) -> Result<bool, Error> {
            self.sent.borrow_mut().push(*frame);
            for motor in self.motors.borrow_mut().iter_mut() {
                let answers = motor.take(frame).expect("it can be encoded");
                self.waiting.borrow_mut().extend(answers);
            }
            Ok(true)
        }

        fn receive(&self, _: Duration) -> Result<Option<(Stamp, BusEvent)>, Error> {
            let now = *self.now.borrow() + Duration::from_millis(1);
            if self.waiting.borrow().is_empty() {
                *self.now.borrow_mut() = now;
                for motor in self.motors.borrow_mut().iter_mut() {
                    let reports = motor.report(now).expect("it can be encoded");
                    self.waiting.borrow_mut().extend(reports);
                }
            }
            let frame = self.waiting.borrow_mut().pop_front();
            Ok(frame.map(|frame| (now, BusEvent::Frame(frame))))
        }
    }

    /// A bus without other nodes.
    struct EmptyBus {
        n_sent: RefCell<usize>,
    }

    impl FrameIo for EmptyBus {
        fn interface(&self) -> &str {
            "can0"
        }

        fn send(&self, _: &Frame) -> Result<bool, Error> {
            *self.n_sent.borrow_mut() += 1;
            Ok(true)
        }

        fn receive(&self, _: Duration) -> Result<Option<(Stamp, BusEvent)>, Error> {
            let errors = WireErrors {
                n_unacknowledged: 1,
                ..WireErrors::default()
            };
            let is_sent = *self.n_sent.borrow() > 0;
            Ok(is_sent.then_some((Stamp(0), BusEvent::Errors(errors))))
        }
    }

    fn motor(family: &str, settings: MotorSettings) -> Arc<dyn MotorProtocol> {
        let family = FAMILIES.iter().find(|known| known.name() == family);
        let family = family.expect("a known family");
        family.motor(&settings).expect("complete settings")
    }

    #[test]
    fn motors_are_found_by_heartbeats_and_answers() {
        let damiao =
            |id: u64| MotorSettings::new(id).with("feedback_id", SettingValue::Whole(id + 0x10));
        let robstride = MotorSettings::new(127_u64).with("model", SettingValue::Word("rs02"));
        let bus = MotorBus::with(&[
            motor("odrive", MotorSettings::new(9_u64)),
            motor("damiao", damiao(2)),
            motor("damiao", damiao(1)),
            motor("robstride", robstride),
        ]);
        let found = motors_on(&bus, TIMES).expect("the bus works");
        let found: Vec<_> = found
            .iter()
            .map(|motor| (motor.family.name(), &motor.settings))
            .collect();
        // A Robstride motor does not report its model.
        let expected = [
            ("damiao", &damiao(1)),
            ("damiao", &damiao(2)),
            ("robstride", &MotorSettings::new(127_u64)),
            ("odrive", &MotorSettings::new(9_u64)),
        ];
        assert_eq!(found, expected);
        let is_off = |motor: &EmulatedMotor| motor.state() != crate::can::emulated::State::Enabled;
        assert!(bus.motors.borrow().iter().all(is_off));
    }

    #[test]
    fn requests_end_if_nobody_acknowledges_them() {
        let bus = EmptyBus {
            n_sent: RefCell::new(0),
        };
        assert_eq!(motors_on(&bus, TIMES).expect("no error"), []);
        assert_eq!(*bus.n_sent.borrow(), 1);
    }

    /// The requests of one family must not move the motors of another one.
    #[test]
    fn requests_are_no_commands_of_other_families() {
        let bus = MotorBus::with(&[]);
        motors_on(&bus, TIMES).expect("the bus works");
        for frame in bus.sent.borrow().iter() {
            // Robstride's requests have extended identifiers, which only its motors use. Damiao's
            // registers have the highest standard identifier, which no motor has.
            let is_safe = frame.id().is_extended() || frame.id().value() == 0x7FF;
            assert!(is_safe, "{frame:?}");
        }
        assert!(bus.sent.borrow().len() > 100);
    }
}
