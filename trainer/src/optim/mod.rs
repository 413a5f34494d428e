//! Optimizer steps.

pub mod reference;
