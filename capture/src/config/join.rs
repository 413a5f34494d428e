//! The keys in `[join]`, which select keyframes.

use super::key::keys;

keys! {
    /// Which images become keyframes, and how many are kept.
    #[derive(Clone, Debug, PartialEq)]
    pub struct JoinConfig {
        /// Number of keyframes with which training starts. Without this key, 1 in real time with depth,
        /// otherwise 5.
        pub start_keyframes: Option<usize>, in 1..=100_000;
        /// Maximum number of keyframes in the store.
        pub max_keyframes: usize = 400, in 8..=1_000_000;
        /// Maximum host memory of the keyframes in the store, bytes.
        pub max_bytes: u64 = 4_000_000_000, in 1_000_000..=1 << 50;
        /// Minimum distance to every keyframe of the same camera, meters. A new keyframe needs this
        /// distance or the rotation `min_rotation_rad`.
        pub min_translation_m: f64 = 0.02, in 1e-6..=100.0;
        /// Minimum rotation relative to every keyframe of the same camera, radians.
        pub min_rotation_rad: f64 = 0.05, in 1e-6..=3.2;
        /// Interval between keyframes of a camera that cannot move, milliseconds.
        pub fixed_interval_millis: f64 = 1000.0, in 0.0..=1e9;
        /// Maximum number of keyframes of such a camera.
        pub fixed_keyframes: usize = 16, in 1..=1_000_000;
        /// Minimum sharpness relative to the median of the last images of the camera.
        pub min_sharpness_frac: f64 = 0.35, in 0.0..=1.0;
        /// Maximum predicted motion blur, pixels.
        pub max_blur_px: f64 = 1.5, in 0.0..=1000.0;
        /// Maximum predicted rolling-shutter shear, pixels.
        pub max_shear_px: f64 = 40.0, in 0.0..=1000.0;
        /// Minimum mean brightness.
        pub min_luma_frac: f64 = 0.03, in 0.0..=1.0;
        /// Maximum mean brightness.
        pub max_luma_frac: f64 = 0.97, in 0.0..=1.0;
        /// Maximum fraction of black or white pixels.
        pub max_clipped_frac: f64 = 0.5, in 0.0..=1.0;
        /// Scene depth assumed for a camera without depth, meters.
        pub default_depth_m: f64 = 0.5, in 0.01..=1000.0;
        /// Maximum gap between two samples over which poses are interpolated, milliseconds.
        pub max_gap_millis: f64 = 50.0, in 0.1..=10_000.0;
        /// Maximum time that an image waits for other samples, milliseconds.
        pub max_wait_millis: f64 = 500.0, in 1.0..=60_000.0;
        /// Maximum number of range scans kept beside the keyframes.
        pub max_range_scans: usize = 200, in 0..=1_000_000;
    }
}

impl JoinConfig {
    /// Number of keyframes with which training starts. By default, a run in real time starts with
    /// the first keyframe if a camera has depth, because depth shows where surfaces are. Other runs
    /// wait for five keyframes.
    pub fn start_keyframes_or_default(&self, is_real_time: bool, has_depth: bool) -> usize {
        self.start_keyframes
            .unwrap_or(if is_real_time && has_depth { 1 } else { 5 })
    }
}
