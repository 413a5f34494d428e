//! Checks the messages of viewers. Every accepted request must be safe to render, and every
//! accepted subscription must respect its limits. The fuzz target `page` calls this check.

use crate::client::keyframe_image::{KeyframeImageRequest, MAX_PHOTOGRAPH_PX};
use crate::client::negotiation::{capabilities, negotiate};
use crate::client::protocol::{
    BASE_PROTOCOL_VERSION, ClientHello, ClientMessage, EditMessage, KeyframeImageMessage,
    MAX_RATE_HZ, PROTOCOL_VERSION, RenderMessage, ShownMessage, SubscribeMessage,
};
use crate::clock::ServerClock;
use crate::edit::{EditAction, EditRequest};
use crate::pictures::view_request::{MAX_SIZE_PX, ViewRequest};
use crate::topics::TOPICS;
use crate::topics::subscriptions::{Subscriptions, fitted};
use model_files::Aabb;
use trainer::{Projection, RenderRequest};

/// Handles the messages of a client, one per line, and panics if a result is inconsistent.
pub(crate) fn check_messages(messages: &str) {
    let mut subscriptions = Subscriptions::default();
    for text in messages.lines() {
        match serde_json::from_str(text) {
            Ok(ClientMessage::Hello(hello)) => check_hello(&hello),
            Ok(ClientMessage::Render(message)) => check_render(&message),
            Ok(ClientMessage::Subscribe(message)) => {
                check_subscription(&mut subscriptions, message)
            }
            Ok(ClientMessage::Shown(message)) => check_shown(&message),
            Ok(ClientMessage::KeyframeImage(message)) => check_keyframe_image(&message),
            Ok(ClientMessage::Edit(message)) => check_edit(&message),
            Ok(ClientMessage::Control(_) | ClientMessage::Ping(_) | ClientMessage::Goodbye(_))
            | Err(_) => {}
        }
    }
}

fn check_hello(hello: &ClientHello) {
    match negotiate(hello) {
        Ok(agreement) => {
            assert!((BASE_PROTOCOL_VERSION..=PROTOCOL_VERSION).contains(&agreement.protocol));
            assert!(agreement.names.len() <= capabilities().count());
            assert!(
                agreement
                    .names
                    .iter()
                    .all(|name| hello.capabilities.iter().any(|wanted| wanted == name))
            );
        }
        Err(reason) => assert!(!reason.is_empty() && !reason.contains('\n')),
    }
}

fn check_render(message: &RenderMessage) {
    let Ok(request) = ViewRequest::check(message) else {
        return;
    };
    for stage in 0..request.stages.len() {
        let RenderRequest {
            size_px,
            projection,
            world_from_camera,
            ..
        } = request.stage_request(stage);
        assert!(size_px.iter().all(|n| (1..=MAX_SIZE_PX).contains(n)));
        assert!(kinematics::transform::is_finite(&world_from_camera));
        if let Projection::Pinhole {
            focal_px,
            principal_px,
        } = projection
        {
            assert!(
                focal_px
                    .iter()
                    .chain(&principal_px)
                    .all(|number| number.is_finite())
            );
        }
    }
}

fn check_shown(message: &ShownMessage) {
    let clock = ServerClock::start();
    if let Some(shown_at) = clock.instant(message.shown_millis) {
        assert!(shown_at >= clock.instant(0.0).expect("the start"));
        let error = (clock.millis(shown_at) - message.shown_millis).abs();
        assert!(
            error <= 1e-3 + 1e-12 * message.shown_millis,
            "{} ms became {shown_at:?}",
            message.shown_millis
        );
    }
}

fn check_keyframe_image(message: &KeyframeImageMessage) {
    let Ok(request) = KeyframeImageRequest::check(message) else {
        return;
    };
    for size_px in [[640, 480], [1, 4000], [4096, 1]] {
        let fitted = fitted(size_px, request.max_px);
        assert!((0..2).all(|axis| (1..=MAX_PHOTOGRAPH_PX).contains(&fitted[axis])));
    }
}

fn check_edit(message: &EditMessage) {
    let Ok(request) = EditRequest::check(1, message) else {
        return;
    };
    if let EditAction::Erase(Aabb {
        world_from_box,
        min_m,
        max_m,
    }) = request.action()
    {
        assert!(kinematics::transform::is_finite(world_from_box));
        assert!(
            min_m
                .iter()
                .zip(max_m)
                .all(|(min, max)| min < max && min.is_finite() && max.is_finite())
        );
    }
}

fn check_subscription(subscriptions: &mut Subscriptions, message: SubscribeMessage) {
    let camera = message.camera.clone().unwrap_or_default();
    let before = subscriptions.clone();
    if subscriptions.apply(message).is_err() {
        assert!(
            *subscriptions == before,
            "a rejected message changes nothing"
        );
        return;
    }
    let images = subscriptions.images_of(&camera);
    let chunks = subscriptions.model_chunks.as_ref();
    let of_topics = TOPICS
        .iter()
        .filter_map(|entry| subscriptions.period(entry.name));
    let mut periods = of_topics
        .chain(images.period)
        .chain(chunks.map(|chunks| chunks.period));
    assert!(
        chunks.is_none_or(|chunks| chunks.method.len() <= 256 && chunks.max_bytes_per_sec >= 1e4)
    );
    assert!(periods.all(|period| period.as_secs_f64() >= 0.999 / MAX_RATE_HZ));
    for size_px in [[640, 480], [1, 4000], [4096, 1]] {
        let fitted = fitted(size_px, images.max_px);
        assert!(
            (0..2).all(|axis| (1..=size_px[axis]).contains(&fitted[axis])),
            "{size_px:?} became {fitted:?}"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::check_messages;
    use numbers::random::Random;
    use std::path::Path;

    /// The seeds of the fuzz target, unchanged and with changed, removed and repeated bytes.
    #[test]
    fn corrupted_messages_are_handled() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/seeds/page");
        let mut random = Random::new(11);
        let mut n_seeds = 0;
        for entry in std::fs::read_dir(folder).expect("the seeds") {
            let seed = std::fs::read_to_string(entry.expect("a file").path()).expect("text");
            check_messages(&seed);
            for _ in 0..2000 {
                let mut bytes = seed.clone().into_bytes();
                for _ in 0..=random.below(3) {
                    let at = random.below(bytes.len());
                    match random.below(4) {
                        0 => bytes[at] = u8::try_from(32 + random.below(95)).expect("ASCII"),
                        1 => drop(bytes.remove(at)),
                        2 => bytes.insert(at, b"0123456789e-.,[]{}\"\n"[random.below(20)]),
                        _ => {
                            let end = (at + random.below(40)).min(bytes.len());
                            let section = bytes[at..end].to_vec();
                            bytes.splice(at..at, section);
                        }
                    }
                    if bytes.is_empty() {
                        break;
                    }
                }
                check_messages(&String::from_utf8_lossy(&bytes));
            }
            n_seeds += 1;
        }
        assert!(n_seeds >= 3, "only {n_seeds} seeds");
    }
}
