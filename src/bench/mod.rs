//! Many trainings under one question: each is kept in a file of its own as soon as it ends, and all are told in charts.

pub(crate) mod disturb;
pub(crate) mod memory;
pub(crate) mod page;
pub(crate) mod peer;
pub(crate) mod runs;
pub(crate) mod statistics;
pub(crate) mod variant;
pub(crate) mod viewer;
