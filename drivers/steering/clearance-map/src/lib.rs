//! A map of free space around a robot, made from depth images on the CPU.
//!
//! [`ClearanceMap`] answers how far points of an arm are from everything that is not known to be
//! free, and how long ago this was seen. It needs neither the GPU nor a trainer: its own thread
//! integrates depth images, and answers come from the newest complete version of the map.
//!
//! # What is known
//!
//! Space is divided into voxels. A voxel is *free* after a depth image has shown it as a whole in
//! front of all surfaces, with a margin for errors of depth ([`DepthOrigin`]); *occupied* if a
//! reading is inside; and *never seen* otherwise. Each voxel holds the time of the newest image
//! that showed its state. Newer images win, so surfaces that disappear are removed.
//!
//! - **Distance** ([`steering::Seen::distance_m`]): from the point to the closest voxel that is not
//!   free, at most [`MapConfig::max_distance_m`]. Voxels are free only as a whole, so this is a
//!   lower bound of the distance to every surface that was seen, as long as the errors of readings
//!   and poses are within the margin. It is smaller than the true distance by up to the diagonal of
//!   a voxel (1.7 sides), the margin, and the size of a voxel's image: near edges of objects, space
//!   beside the object is not shown as a whole. It is not negative inside objects, because cameras
//!   do not see there: points inside are occupied, or never seen.
//! - **Age**: since the oldest free voxel in this distance was seen, in cubes of four voxels.
//! - **Never seen** (`None`): the point itself is not free, and the robot is not there now.
//!
//! # The robot
//!
//! The capsules of a [`steering::Body`] at the time of an image show which readings are the robot.
//! These are no surfaces; the space in front of them is free. What is closer to the robot than
//! [`MapConfig::robot_margin_m`] is therefore not added to the map, but what is in the map already
//! stays. The volume inside the capsules *now* ([`ClearanceMap::set_posture`]) is free, without any
//! margin: in a region that was never seen, parts can neither enter new space nor widen the space
//! in which they are, but they can leave it.
//!
//! # Bases
//!
//! A base that moves ([`MapBase`]) asks for the points of its footprint with
//! [`steering::Clearance::base_readings`]. The whole footprint where the base is now is free for
//! these answers, not only the parts of the robot in it. A base that may enter space that was never
//! seen gets distances from surfaces alone. Scans of range scanners become depth images with
//! [`images_of_scan`].
//!
//! # Limits
//!
//! - Readings without a neighbor of a similar depth are noise, so a surface must cover at least two
//!   neighboring pixels.
//! - A quarter of a voxel's image may be without readings. Things that cameras do not see at all,
//!   such as thin black cables or glass, are therefore not in the map.
//! - The map is in the frame of the world that the poses use. If a correction moves this frame,
//!   call [`ClearanceMap::forget`].

mod block;
mod blocks;
mod capsules;
mod carve;
mod clock;
mod config;
mod error;
mod footprint;
mod grid;
mod image;
mod map;
mod query;
mod rows;
mod samples;
mod scan;
mod snapshot;
mod surfaces;
#[cfg(test)]
mod tests;
mod view;
mod voxel_map;

pub use config::{MapConfig, reach_m};
pub use error::Error;
pub use image::{DepthImage, DepthOrigin, Posture};
pub use map::{ClearanceMap, MapBase, MapState};
pub use scan::images_of_scan;
