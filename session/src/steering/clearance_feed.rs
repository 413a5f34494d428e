//! Depth for the map of free space from cameras without depth: the live model draws it.
//!
//! A keyframe without dense depth waits until the model has learned it. The model is then drawn at
//! its pose. Pixels whose color differs from that of the keyframe have no reading: the model does
//! not show what the camera saw there, for example because something has just appeared. The map
//! keeps a larger margin for drawn depth than for measured depth, and drawn depth never clears what
//! a depth camera has seen ([`DepthOrigin::Rendered`]).

use super::scene_clearance::SceneClearance;
use super::undrawn::Undrawn;
use crate::evaluate::MIN_ALPHA;
use clearance_map::{DepthImage, DepthOrigin};
use kinematics::Transform;
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::Picture;

/// Steps before which the model is not drawn: depth of a model that has just begun is random.
pub(crate) const MIN_STEPS: u64 = 1000;
/// Minimum time between two drawings, because each one takes time from training.
const MIN_PERIOD: Duration = Duration::from_millis(250);
/// Largest difference of a color channel, of 255, at which the model shows what the camera saw.
/// Noise, compression and an exposure that is not modeled stay below it.
const MAX_COLOR_DIFFERENCE: u8 = 32;

/// Passes drawn depth to the map, at a bounded rate.
pub(crate) struct ClearanceFeed {
    scene: Arc<SceneClearance>,
    drawn_at: Option<Instant>,
}

impl ClearanceFeed {
    pub(super) fn new(scene: Arc<SceneClearance>) -> Self {
        Self {
            scene,
            drawn_at: None,
        }
    }

    /// The next keyframe, if one may be drawn now.
    pub(crate) fn next(&mut self, now: Instant) -> Option<Undrawn> {
        let is_due = |last: Instant| now.duration_since(last) >= MIN_PERIOD;
        if !self.drawn_at.is_none_or(is_due) {
            return None;
        }
        let next = self.scene.undrawn().take_learned(now)?;
        self.drawn_at = Some(now);
        Some(next)
    }

    /// Takes the picture of a keyframe.
    ///
    /// * `world_from_camera`: pose from which it was drawn, after the corrections of the model.
    pub(crate) fn drawn(&self, undrawn: Undrawn, world_from_camera: Transform, picture: &Picture) {
        let Undrawn {
            keyframe, posture, ..
        } = undrawn;
        self.scene.observe_depth(DepthImage {
            depth_m: matching_depth(&keyframe.rgba_srgb, picture).into(),
            camera: keyframe.camera,
            stamp: keyframe.stamp,
            size_px: keyframe.size_px,
            focal_px: keyframe.focal_px,
            principal_px: keyframe.principal_px,
            world_from_camera,
            posture,
            origin: DepthOrigin::Rendered,
        });
    }
}

/// Depth of the pixels that the model covers in the color of the image; 0 for all others.
fn matching_depth(image_rgba: &[u8], picture: &Picture) -> Vec<f32> {
    let images = image_rgba.as_chunks::<4>().0;
    let drawn = picture.rgba_srgb.as_chunks::<4>().0;
    let pixels = images.iter().zip(drawn).zip(&picture.depth_m);
    pixels
        .map(|((image, drawn), depth_m)| {
            let is_valid = image[3] == u8::MAX && drawn[3] >= MIN_ALPHA;
            let is_equal =
                |channel: usize| image[channel].abs_diff(drawn[channel]) <= MAX_COLOR_DIFFERENCE;
            if is_valid && (0..3).all(is_equal) {
                *depth_m
            } else {
                0.0
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_pixels_that_the_model_knows_have_depth() {
        let image = [
            [100, 100, 100, 255],
            [100, 100, 100, 255],
            [100, 100, 100, 255],
            [100, 100, 100, 0],
        ];
        let drawn = [
            [90, 110, 100, 255],
            [90, 110, 160, 255],
            [100, 100, 100, MIN_ALPHA - 1],
            [100, 100, 100, 255],
        ];
        let picture = Picture {
            size_px: [4, 1],
            rgba_srgb: drawn.concat(),
            depth_m: vec![1.0; 4],
        };
        assert_eq!(
            matching_depth(&image.concat(), &picture),
            [1.0, 0.0, 0.0, 0.0]
        );
    }
}
