//! Tests of the simulated rigs.

mod common;
mod live_rig;
mod mobile;
mod rig;
mod twin;
