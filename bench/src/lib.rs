//! Benchmarks that train many models: each run is saved to a file when it ends, and the results are drawn as charts.

pub(crate) mod disturb;
pub(crate) mod memory;
pub(crate) mod page;
pub(crate) mod peer;
pub(crate) mod runs;
pub(crate) mod statistics;
pub(crate) mod variant;
pub(crate) mod viewer;
