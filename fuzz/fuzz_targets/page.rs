//! Fuzz target for requests of the web page: every accepted request must be safe to render. The crates `viz` and
//! `trainer` are not linked, to keep the build fast.
#![no_main]
#![allow(dead_code, reason = "only client messages are tested here")]

extern crate self as trainer;

#[path = "../../viz/src/clock.rs"]
mod clock;
#[path = "../../viz/src/pose.rs"]
mod pose;
#[path = "../../viz/src/protocol.rs"]
mod protocol;
#[path = "../../trainer/src/request.rs"]
mod request;
#[path = "../../viz/src/updates.rs"]
mod updates;
#[path = "../../viz/src/view_request.rs"]
mod view_request;

pub use request::{Aabb, Projection, RenderRequest};

libfuzzer_sys::fuzz_target!(|text: &str| {
    let Ok(protocol::ClientMessage::Render(message)) = serde_json::from_str(text) else { return };
    let Ok(request) = view_request::ViewRequest::check(&message) else { return };
    for stage in 0..request.stages.len() {
        let RenderRequest { size_px, projection, world_from_camera, .. } = request.stage_request(stage);
        assert!(size_px.iter().all(|n| (1..=view_request::MAX_SIZE_PX).contains(n)));
        assert!(kinematics::transform::is_finite(&world_from_camera));
        if let Projection::Pinhole { focal_px, principal_px } = projection {
            assert!(focal_px.iter().chain(&principal_px).all(|number| number.is_finite()));
        }
    }
});
