//! How far a rendered image is from a keyframe.

pub mod reference;
