//! Scene extent and initial view.

use crate::Hub;
use crate::client::server_message::ServerMessage;
use crate::clock::ServerClock;
use crate::topics::published_data::SceneHint;
use crate::topics::shared_topic::{SharedTopic, only_message};
use crate::topics::{DefaultRate, Priority};
use axum::extract::ws::Message;
use std::sync::Arc;

/// The topic. Every client receives it, because it cannot choose a view without it.
#[derive(Default)]
pub(crate) struct SceneTopic;

impl SharedTopic for SceneTopic {
    const NAME: &'static str = "scene";
    const DEFAULT: DefaultRate = DefaultRate::Always;
    const PRIORITY: Priority = Priority::Short;
    const CAPABILITY: Option<&'static str> = None;
    type Source = Option<Arc<SceneHint>>;

    fn encode(&mut self, source: &Self::Source, _: ServerClock) -> Vec<(Arc<str>, Message)> {
        let message = source
            .as_ref()
            .map(|hint| ServerMessage::from(&**hint).to_message());
        only_message(message)
    }
}

impl Hub {
    /// Sets the scene extent and the initial view.
    pub fn set_scene_hint(&self, hint: SceneHint) {
        self.latest::<Option<Arc<SceneHint>>>()
            .send_replace(Some(Arc::new(hint)));
    }
}
