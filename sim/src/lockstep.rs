//! A rig that waits for whoever takes its samples.

use crate::engine::Engine;
use crate::rig::RigInfo;
use drivers::{Sample, Source};

/// Samples of a rig in the order of their delivery; the same bits for the same configuration and machine.
pub struct Lockstep {
    engine: Engine,
    info: RigInfo,
}

impl Lockstep {
    pub(crate) fn new(engine: Engine, info: RigInfo) -> Self {
        Self { engine, info }
    }

    /// What the rig is made of.
    pub fn info(&self) -> &RigInfo {
        &self.info
    }
}

impl Source for Lockstep {
    fn next_sample(&mut self) -> Result<Option<Sample>, drivers::Error> {
        let delivery = self.engine.next().map_err(|error| drivers::Error::Simulation { reason: error.to_string() })?;
        Ok(delivery.map(|(_, sample)| sample))
    }
}
