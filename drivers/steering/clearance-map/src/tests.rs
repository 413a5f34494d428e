//! Tests against scenes whose distances are known exactly.

mod capsule_tests;
mod distance_tests;
mod map_tests;
mod robot_tests;
mod scene;
mod time_tests;
