//! View code that all methods share: cameras, erased space, and depth in the color camera's view.

mod camera;
mod depth;
mod erased;

pub(crate) use camera::{Camera, LOW_PASS_PX2, TILE_PX, View, rows_of};
pub(crate) use depth::{depth_in_color_view, median_depth_m};
pub(crate) use erased::ErasedSpace;
