//! A rig that advances only when its samples are taken.

use crate::engine::Engine;
use crate::rig_info::RigInfo;
use drivers::{Sample, Source};

/// Samples of a rig in delivery order. On one machine, the same configuration gives bit-identical
/// samples.
pub struct Lockstep {
    engine: Engine,
    info: RigInfo,
}

impl Lockstep {
    pub(crate) fn new(engine: Engine, info: RigInfo) -> Self {
        Self { engine, info }
    }

    /// True parameters of the rig.
    pub fn info(&self) -> &RigInfo {
        &self.info
    }
}

impl Source for Lockstep {
    fn next_sample(&mut self) -> Result<Option<Sample>, drivers::Error> {
        let delivery = self
            .engine
            .next()
            .map_err(|error| drivers::Error::Simulation {
                reason: error.to_string(),
            })?;
        Ok(delivery.map(|(_, sample)| sample))
    }
}
