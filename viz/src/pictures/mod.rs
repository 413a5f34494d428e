//! Rendered pictures: requests, their order, encoding.

pub(crate) mod compact_depth;
pub(crate) mod jpeg;
pub(crate) mod picture;
pub(crate) mod picture_requests;
pub(crate) mod picture_times;
pub(crate) mod queue;
pub(crate) mod view_request;
pub(crate) mod viewpoint;
