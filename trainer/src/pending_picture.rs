//! A picture that the GPU may still be rendering, so that training continues while another thread waits for it.

use crate::{Error, Picture};
use std::fmt;

/// A picture in progress, or a finished one.
pub struct PendingPicture(Box<dyn FnOnce() -> Result<Option<Picture>, Error> + Send>);

impl PendingPicture {
    /// A finished picture.
    pub fn ready(picture: Picture) -> Self {
        Self::new(|| Ok(Some(picture)))
    }

    /// A picture that `finish` waits for.
    pub(crate) fn new(finish: impl FnOnce() -> Result<Option<Picture>, Error> + Send + 'static) -> Self {
        Self(Box::new(finish))
    }

    /// Waits for the picture. `None` if a buffer was too small for it: request the picture again, the buffer will be
    /// larger.
    ///
    /// # Errors
    ///
    /// If the GPU failed.
    pub fn finish(self) -> Result<Option<Picture>, Error> {
        (self.0)()
    }
}

impl fmt::Debug for PendingPicture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("PendingPicture")
    }
}
