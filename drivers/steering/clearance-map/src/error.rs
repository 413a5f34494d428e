//! Errors of a configuration or an image, found before they change the map.

/// Why a map cannot be built, or why it refuses an image or a posture.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A value is out of its range.
    #[error("clearance map: {what} is {value}, must be {expected}")]
    Value {
        /// Name of the value.
        what: &'static str,
        /// Value found.
        value: f64,
        /// Accepted values.
        expected: &'static str,
    },
    /// The number of depth pixels does not match the size.
    #[error(
        "clearance map: depth image of camera {camera:?} has {got} pixels, expected {expected} for its size of \
         {width}x{height}"
    )]
    PixelCount {
        /// Name of the camera.
        camera: String,
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
        /// Number of pixels found.
        got: usize,
        /// Number of pixels expected.
        expected: usize,
    },
    /// A pose or a lens has a value that is not finite, or a focal length that is not positive.
    #[error("clearance map: {what} of camera {camera:?} is not finite or not positive")]
    Camera {
        /// Name of the value.
        what: &'static str,
        /// Name of the camera.
        camera: String,
    },
    /// A posture has the wrong number of joints.
    #[error("clearance map: the posture has {got} joints, the body has {expected}")]
    JointCount {
        /// Number of joints found.
        got: usize,
        /// Number of joints expected.
        expected: usize,
    },
    /// A posture has a value that is not finite.
    #[error("clearance map: {what} is not finite")]
    NotFinite {
        /// Name of the value.
        what: &'static str,
    },
    /// The thread could not be started.
    #[error(
        "clearance map: cannot start its thread: {0}; close other programs or raise the limit on threads"
    )]
    Thread(#[from] std::io::Error),
}
