//! Scenes of 3D Gaussians (splats).

#[cfg(test)]
mod against_twin;
#[cfg(test)]
mod alignment_tests;
mod arrival_gains;
pub mod bench;
mod bounds;
mod buffers;
mod camera_params;
#[cfg(test)]
mod change_against_twin;
#[cfg(test)]
mod checkpoint_tests;
mod chunks;
#[cfg(test)]
mod clip_against_twin;
mod clipping;
#[cfg(test)]
mod edit_tests;
mod entry;
mod few_images;
mod floaters;
pub mod kernels;
mod nearest;
#[cfg(test)]
mod non_finite_tests;
mod options;
mod params;
mod passes;
pub mod reference;
mod schedule;
mod seed;
mod snapshot;
mod stereo;
#[cfg(test)]
mod stereo_tests;
mod trainer;
#[cfg(test)]
mod training_tests;
mod trial_steps;
#[cfg(test)]
mod trial_tests;
mod trials;
mod views;
mod work_counts;

pub(crate) use entry::ENTRY;
pub use options::SplatOptions;
pub use trainer::SplatTrainer;
pub use trial_steps::TrialSteps;
pub use trials::CountPolicy;
pub use work_counts::WorkCounts;
