//! `ODrive` axes with CANSimple. They send their encoder estimates and heartbeats periodically.
//!
//! Watchdog: `axis0.config.watchdog_timeout` and `enable_watchdog`. When it expires, the axis is
//! disarmed. Source: ODrive documentation, error `WATCHDOG_TIMER_EXPIRED`.

pub mod codec;
#[cfg(feature = "emulation")]
pub mod emulated;
mod endpoints;
#[cfg(any(test, fuzzing))]
mod fuzz;
mod motion;

pub use codec::Node;
pub use endpoints::{Endpoints, EndpointsError};

use super::family::{
    MotionProtocol, MotorFamily, MotorProtocol, MotorReading, Reports, Traffic, UNLIMITED,
    short_frame,
};
use super::query::MotorQuery;
use super::settings::MotorSettings;
use super::watchdog::Watchdog;
use crate::Error;
use crate::motion::OnLoss;
use crate::wire::can::Frame;
use crate::wire::can::mit::Limits;
use codec::Answer;
use std::ops::RangeInclusive;
use std::sync::Arc;

/// Default rate of encoder messages. It is used to estimate the bus load. The estimate is wrong for
/// an axis with another rate.
const REPORT_HZ: f64 = 100.0;
/// Default rate of heartbeats, which contain the state of the axis.
const HEARTBEAT_HZ: f64 = 10.0;

/// The family.
#[derive(Debug)]
pub struct OdriveFamily;

impl MotorFamily for OdriveFamily {
    fn name(&self) -> &'static str {
        "odrive"
    }

    fn title(&self) -> &'static str {
        "ODrive"
    }

    /// Excludes 63, which means that no ID is assigned.
    fn ids(&self) -> RangeInclusive<u64> {
        0..=62
    }

    fn has_gains(&self) -> bool {
        false
    }

    fn motor(&self, settings: &MotorSettings) -> Option<Arc<dyn MotorProtocol>> {
        Some(Arc::new(Odrive {
            node: node_of(settings)?,
            endpoints: None,
        }))
    }

    fn identify(&self, frame: &Frame) -> Option<MotorSettings> {
        let (node, answer) = codec::decode_answer(frame).ok()?;
        let is_axis = matches!(answer, Answer::Heartbeat { .. })
            && self.ids().contains(&node.number().into());
        is_axis.then(|| MotorSettings::new(node.number()))
    }

    #[cfg(any(test, fuzzing))]
    fn fuzzing(&self) -> super::family::FamilyFuzzing {
        fuzz::fuzzing()
    }
}

/// An `ODrive` axis.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Odrive {
    /// Node ID of the axis.
    pub node: Node,
    /// Endpoint numbers of its firmware. Without them, its watchdog cannot be set. They are
    /// separate from the settings of the motor, because the rig file names one file for all axes of
    /// an arm.
    pub endpoints: Option<Endpoints>,
}

/// Sets the endpoint numbers of a motor if it is an `ODrive` axis. Other motors do not change.
pub fn set_endpoints(motor: &mut Arc<dyn MotorProtocol>, endpoints: Option<&Endpoints>) {
    if motor.family().name() != OdriveFamily.name() {
        return;
    }
    if let Some(node) = node_of(&motor.settings()) {
        let endpoints = endpoints.cloned();
        *motor = Arc::new(Odrive { node, endpoints });
    }
}

/// Node ID of the axis with these settings; `None` if the ID is not allowed.
fn node_of(settings: &MotorSettings) -> Option<Node> {
    Node::new(u8::try_from(settings.id).ok()?).ok()
}

impl MotorProtocol for Odrive {
    fn family(&self) -> &'static dyn MotorFamily {
        &OdriveFamily
    }

    fn settings(&self) -> MotorSettings {
        MotorSettings::new(self.node.number())
    }

    fn addresses(&self) -> Vec<u32> {
        vec![self.node.number().into()]
    }

    fn ranges(&self) -> Option<Limits> {
        Some(UNLIMITED)
    }

    fn set_up(&self, _query: &MotorQuery<'_>) -> Result<Limits, Error> {
        Ok(UNLIMITED)
    }

    fn reports(&self) -> Reports {
        Reports::Unasked {
            if_silent: "it sends no encoder estimates; set axis0.config.can.encoder_msg_rate_ms = 10, and check its node_id",
        }
    }

    fn typical_answer(&self) -> (Frame, Option<f64>) {
        (short_frame(), Some(REPORT_HZ))
    }

    fn read(&self, frame: &Frame, _limits: &Limits) -> Option<MotorReading> {
        match codec::decode_answer(frame) {
            Ok((
                from,
                Answer::Motion {
                    position_rad,
                    velocity_rad_s,
                },
            )) if from == self.node => Some(MotorReading {
                position_rad,
                velocity_rad_s,
                torque_nm: None,
            }),
            _ => None,
        }
    }

    fn traffic(&self) -> Traffic {
        let unsolicited = vec![(short_frame(), REPORT_HZ), (short_frame(), HEARTBEAT_HZ)];
        Traffic {
            cycle_frames: vec![short_frame()],
            unsolicited,
        }
    }

    fn watchdog(&self) -> Watchdog {
        // The endpoint numbers change with the firmware. Without the file of this firmware, a write
        // could change any other setting of the axis.
        match self.endpoints {
            Some(_) => Watchdog::Available(&[OnLoss::Release]),
            None => Watchdog::Missing {
                reason: "without arm.motion.odrive_endpoints the watchdog of this axis cannot be set",
                // An axis in position mode holds its last target. It has no command for
                // damping.
                actions: &[OnLoss::Hold, OnLoss::Release],
            },
        }
    }

    fn motion(&self, _limits: &Limits) -> Box<dyn MotionProtocol> {
        Box::new(motion::OdriveMotion {
            node: self.node,
            endpoints: self.endpoints.clone(),
        })
    }

    #[cfg(feature = "emulation")]
    fn emulated(&self) -> Box<dyn super::emulated::EmulatedProtocol> {
        Box::new(emulated::EmulatedOdrive { node: self.node })
    }
}
