//! [`Lpips`] in builds without the feature `lpips`.

use super::PixelPair;
use crate::Error;
use std::path::Path;

/// The learned perceptual distance of two pictures. This build cannot compute it, so the type has
/// no values.
#[derive(Debug)]
pub enum Lpips {}

impl Lpips {
    /// # Errors
    /// Always returns [`Error::LpipsNotBuilt`].
    pub fn load(_: &Path) -> Result<Self, Error> {
        Err(Error::LpipsNotBuilt)
    }

    /// The distance of the two pictures.
    pub fn distance(&self, _: &PixelPair<'_>) -> Result<f64, Error> {
        match *self {}
    }
}
