//! View code that all methods share: cameras, and depth in the color camera's view.

mod camera;
mod depth;

pub(crate) use camera::{Camera, LOW_PASS_PX2, TILE_PX, View, rows_of};
pub(crate) use depth::{depth_in_color_view, median_depth_m};
