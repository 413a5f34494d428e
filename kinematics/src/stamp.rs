//! Points in time on one monotonic clock.

/// Nanoseconds on one monotonic clock; of an image, at mid-exposure when the device says so.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Stamp(pub i64);
