//! The plain CPU version of the field in f64: what every kernel of `nerf` is compared with.
//!
//! A point is contracted into the unit cube (`space`), looked up in a hash grid (`grid`), and two networks (`network`) turn
//! what is found there into density and color (`field`). Samples along a ray are composited, and the loss of a ray is taken
//! and carried back (`ray`), to the pose of its image too (`pose`).
//!
//! Source: Mueller et al. 2022 (Instant NGP); Barron et al. 2022 (Mip-NeRF 360, contraction and distortion); Tancik et al.
//! 2023 (Nerfstudio, appearance codes).

pub mod field;
pub mod grid;
pub mod march;
pub mod network;
pub mod pose;
pub mod ray;
pub mod space;

#[cfg(test)]
pub(crate) mod scene;
#[cfg(test)]
mod tests;
