//! Views that all methods share: cameras, projections of pictures, and depth as the color camera sees it.

mod camera;
mod depth;
pub(crate) mod projections;

pub(crate) use camera::{Camera, LOW_PASS_PX2, TILE_PX, View, rows_of};
pub(crate) use depth::{depth_in_color_view, median_depth_m};
