//! Tests of the server, the protocol and the page in one program, so that they are linked once and
//! fill all processors.

mod admission;
mod black_page;
mod client;
mod coverage_page;
mod downloads;
mod edits_page;
mod ending_page;
mod eye_page;
#[cfg(feature = "foxglove")]
mod foxglove;
mod hands_page;
mod headset_page;
mod headset_steering;
mod keyframe_browser_page;
mod keyframe_images;
mod labels_page;
mod local_page;
mod model_chunks;
mod models;
mod negotiation;
mod page;
mod page_latency;
mod page_tasks;
mod preview_page;
mod protocol;
mod proxy;
mod remember_page;
mod request_thread;
mod robot;
mod robot_page;
mod shared;
mod shared_page;
mod shown_pictures;
mod slow;
mod steering;
mod steering_client;
mod steering_hostile;
mod steering_page;
mod tls;
mod unsupported_page;
mod video_page;
mod views_page;
