//! Plain CPU version of the field in f64. It contains the twin of every kernel of `nerf`.
//!
//! A point is contracted to the unit cube (`model_files::contraction`, with its gradient in
//! `space`) and looked up in a hash grid (`grid`). Two networks (`network`) map its features to
//! density and color (`field`). Samples along a ray are composited, and the loss of a ray is
//! computed and backpropagated (`ray`). The loss is also backpropagated to the pose of the image
//! (`pose`).
//!
//! Sources: Mueller et al. 2022 (Instant NGP) for the hash grid and the networks, Barron et al.
//! 2022 (Mip-NeRF 360) for contraction and distortion, and Tancik et al. 2023 (Nerfstudio) for
//! appearance embeddings.

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
