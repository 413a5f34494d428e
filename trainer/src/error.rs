//! What can go wrong in training.

/// Errors of the trainer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No GPU, real or software, answers.
    #[error("no GPU adapter found: install a Vulkan driver (software: the package mesa-vulkan-drivers)")]
    NoAdapter,
}
