//! Where a camera is, by AprilTags whose places are known.
//!
//! `spotter` finds tags in images, in a thread of its own, with the reference implementation of AprilTag 3; `locate` makes the
//! camera's pose of the corners of all tags in an image; `steady` averages poses while nothing moves.

mod locate;
mod spotter;
mod steady;

pub use locate::{Located, PlacedTag, Seeing, Unlocated, locate};
pub use spotter::{Family, Sighting, Spotted, Spotter};
pub use steady::Steady;
