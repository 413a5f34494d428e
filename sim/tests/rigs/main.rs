//! Tests of the simulated rigs.

mod common;
mod live;
mod mobile;
mod rig;
