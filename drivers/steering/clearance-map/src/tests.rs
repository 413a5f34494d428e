//! Tests against scenes whose distances are known exactly.
#![expect(clippy::cast_possible_truncation, reason = "small numbers of tests")]

mod base_tests;
mod capsule_tests;
mod distance_tests;
pub(crate) mod map_tests;
mod robot_tests;
mod scene;
mod time_tests;
