//! Errors of keyframes.

/// An error of a keyframe.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An image does not have four bytes per pixel.
    #[error("keyframe image of {width}x{height} pixels: got {got} bytes, expected {expected}")]
    ImageBytes {
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
        /// Actual size, bytes.
        got: usize,
        /// Expected size, bytes.
        expected: usize,
    },
    /// A depth image does not have one value per pixel.
    #[error("keyframe depth of {width}x{height} pixels: got {got} values, expected {expected}")]
    DepthPixels {
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
        /// Actual number of values.
        got: usize,
        /// Expected number of values.
        expected: usize,
    },
}
