//! Neural radiance fields: a hash grid and two small networks that tell density and color of any point.

#[cfg(test)]
mod against_twin;
mod buffers;
mod kernels;
mod params;
mod passes;
pub mod reference;
