//! Extent of the scene, and the view of its first camera.

use crate::Hub;
use crate::client::server_message::ServerMessage;
use crate::clock::ServerClock;
use crate::topics::published_data::{PublishedScene, SceneBounds, SceneHint};
use crate::topics::shared_topic::{SharedTopic, only_message};
use crate::topics::{DefaultRate, Priority};
use axum::extract::ws::Message;
use std::sync::Arc;

/// The topic. Every client receives it, because a client cannot choose a view without the extent of
/// the scene.
#[derive(Default)]
pub(crate) struct SceneTopic;

impl SharedTopic for SceneTopic {
    const NAME: &'static str = "scene";
    const DEFAULT: DefaultRate = DefaultRate::Always;
    const PRIORITY: Priority = Priority::Short;
    const CAPABILITY: Option<&'static str> = None;
    type Source = Option<Arc<PublishedScene>>;

    fn encode(&mut self, source: &Self::Source, _: ServerClock) -> Vec<(Arc<str>, Message)> {
        let message = source
            .as_ref()
            .map(|scene| ServerMessage::from(&**scene).to_message());
        only_message(message)
    }
}

impl Hub {
    /// Sets the extent of the scene and the initial view of clients.
    pub fn set_scene_hint(&self, hint: SceneHint) {
        publish(self, PublishedScene { hint, bounds: None });
    }

    /// Sets the extent of the scene. Initially, clients show everything in the bounds, together
    /// with the robot and its path. They offer the view of the hint as a second view.
    pub fn set_scene(&self, hint: SceneHint, bounds: SceneBounds) {
        let bounds = Some(bounds);
        publish(self, PublishedScene { hint, bounds });
    }
}

fn publish(hub: &Hub, scene: PublishedScene) {
    hub.latest::<Option<Arc<PublishedScene>>>()
        .send_replace(Some(Arc::new(scene)));
}
