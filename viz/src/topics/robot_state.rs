//! The topic of the robot: its description, which clients receive once, and its state.

use crate::Hub;
use crate::client::server_message::ServerMessage;
use crate::clock::ServerClock;
use crate::topics::base_path::BasePath;
use crate::topics::robot_description::{RobotDescription, RobotMessage};
use crate::topics::shared_topic::{SharedTopic, only_message};
use crate::topics::{DefaultRate, Priority};
use axum::extract::ws::Message;
use keyframe::RobotState;
use std::sync::Arc;

/// The robot's description, which clients need before its states. `client/writer.rs` sends the
/// states, which do not wait for the period of a topic.
#[derive(Default)]
pub(crate) struct RobotDescriptionTopic;

impl SharedTopic for RobotDescriptionTopic {
    const NAME: &'static str = "robot_state";
    const DEFAULT: DefaultRate = DefaultRate::Off;
    const PRIORITY: Priority = Priority::Short;
    const CAPABILITY: Option<&'static str> = Some("robot");
    type Source = Option<Arc<RobotDescription>>;

    fn encode(&mut self, source: &Self::Source, _: ServerClock) -> Vec<(Arc<str>, Message)> {
        let message = source
            .as_ref()
            .map(|robot| ServerMessage::Robot(&RobotMessage::from(&**robot)).to_message());
        only_message(message)
    }
}

impl Hub {
    /// Sets the robot that clients draw.
    pub fn set_robot(&self, robot: RobotDescription) {
        self.latest::<Option<Arc<RobotDescription>>>()
            .send_replace(Some(Arc::new(robot)));
    }

    /// Sets the current state of the robot.
    pub fn set_robot_state(&self, state: RobotState) {
        let position_m = state.world_from_base.translation.vector.into();
        self.latest::<BasePath>()
            // `push` leaves out positions close to the last one. They must not cause a new message
            // with the whole path.
            .send_if_modified(|path| path.push(position_m, state.stamp));
        self.latest::<Option<Arc<RobotState>>>()
            .send_replace(Some(Arc::new(state)));
    }

    /// Whether a client draws the robot, or the path of its base is due.
    pub fn needs_robot_state(&self) -> bool {
        // States are computed on the thread that joins the samples. It should not compute them if
        // nobody uses them. The path is an exception: it is recorded even if no client is connected,
        // so that later clients receive all of it.
        self.is_observed()
            || self.latest::<BasePath>().borrow().is_due()
            || self.demands().has_topic(RobotDescriptionTopic::NAME)
    }
}
