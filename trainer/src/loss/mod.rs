//! The training loss, which is the difference between a rendered image and a keyframe.

pub mod reference;
pub mod rendered_image;
