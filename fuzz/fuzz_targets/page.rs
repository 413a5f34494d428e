//! Fuzz target for messages of viewers. The crates `viz` and `trainer` are not linked, to keep the build fast.
#![no_main]
#![allow(dead_code, reason = "only client messages are tested here")]

extern crate self as trainer;

#[path = "../../viz/src/message_checks.rs"]
mod message_checks;
#[path = "../../viz/src/negotiation.rs"]
mod negotiation;
#[path = "../../viz/src/pose.rs"]
mod pose;
#[path = "../../viz/src/protocol.rs"]
mod protocol;
#[path = "../../trainer/src/request.rs"]
mod request;
#[path = "../../viz/src/subscriptions.rs"]
mod subscriptions;
#[path = "../../viz/src/view_request.rs"]
mod view_request;

pub use request::{Aabb, Projection, RenderRequest};

libfuzzer_sys::fuzz_target!(|session: &str| message_checks::check_session(session));
