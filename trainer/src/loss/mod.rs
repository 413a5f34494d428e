//! The training loss: difference between a rendered image and a keyframe.

pub mod reference;
pub mod rendered_image;
