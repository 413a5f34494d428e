//! A text that the web page sends: what is accepted can be drawn. The crates `viz` and `trainer` are not linked, for the time it takes.
#![no_main]
#![allow(dead_code, reason = "only what a client says is looked at here")]

extern crate self as trainer;

#[path = "../../viz/src/news.rs"]
mod news;
#[path = "../../viz/src/pose.rs"]
mod pose;
#[path = "../../viz/src/protocol.rs"]
mod protocol;
#[path = "../../viz/src/render_order.rs"]
mod render_order;
#[path = "../../trainer/src/request.rs"]
mod request;

pub use request::{Aabb, Projection, RenderRequest};

libfuzzer_sys::fuzz_target!(|text: &str| {
    let Ok(protocol::ClientMessage::Render(message)) = serde_json::from_str(text) else { return };
    let Ok(order) = render_order::RenderOrder::check(&message) else { return };
    for stage in 0..order.stages.len() {
        let RenderRequest { size_px, projection, world_from_camera, .. } = order.stage_request(stage);
        assert!(size_px.iter().all(|n| (1..=render_order::MAX_SIZE_PX).contains(n)));
        assert!(kinematics::transform::is_finite(&world_from_camera));
        if let Projection::Pinhole { focal_px, principal_px } = projection {
            assert!(focal_px.iter().chain(&principal_px).all(|number| number.is_finite()));
        }
    }
});
