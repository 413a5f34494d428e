//! Neural radiance fields: a hash grid and two small networks that predict density and color of any
//! point.

#[cfg(test)]
mod against_twin;
pub mod bench;
mod buffers;
mod carve;
mod entry;
mod extent;
mod field_trainer;
mod files;
mod kernels;
#[cfg(test)]
mod march_against_twin;
mod model;
mod options;
mod params;
mod passes;
mod rays;
pub mod reference;
mod sizes;
#[cfg(test)]
mod tests;

pub(crate) use entry::ENTRY;
pub use extent::Extent;
pub use model::NerfModel;
pub use options::{NerfBudget, NerfOptions};
