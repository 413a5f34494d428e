//! Steps of the optimiser.

pub mod reference;
