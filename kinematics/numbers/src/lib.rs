//! Functions for numbers without a unit or frame: reproducible random numbers, medians and
//! quantiles, and rounding to f32.
//!
//! ```
//! use numbers::quantile::median;
//! use numbers::random::Random;
//!
//! let mut random = Random::new(1);
//! let values: Vec<f64> = (0..1000).map(|_| random.normal()).collect();
//! assert!(median(&values).is_some_and(|middle| middle.abs() < 0.1));
//! ```

pub mod quantile;
pub mod random;
mod rounding;

pub use rounding::{f32_of, f32s_of};
