//! Time offsets of cameras that accelerate.
//!
//! Corrects time offsets for the acceleration of cameras.
//!
//! A time offset is applied to the pose of an image as a motion with constant velocity. If the
//! camera accelerates by 1 m/s², the pose after an offset of 8 ms is wrong by 0.03 mm in each
//! image. This error is larger than the standard deviation of extrinsics from a scan of 30 s. It
//! does not average out, because acceleration and camera direction are correlated in a scan. The
//! velocities of neighboring images give the acceleration. With the acceleration, the motion is
//! correct up to the second order.

use super::corrections::Corrections;
use super::prepared_image::PreparedImage;
use keyframe::Keyframe;
use kinematics::{Stamp, Twist};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Smaller offsets do not matter, because the error is 0.005 mm even at 10 m/s².
const MIN_OFFSET_SECS: f64 = 1e-3;
/// Maximum time between two images whose velocities are compared. An arm changes its acceleration
/// within about this time.
const MAX_GAP_SECS: f64 = 0.5;

/// The velocities of each camera at its images, by time.
pub(super) struct Velocities<'a> {
    by_camera: BTreeMap<&'a str, Vec<(Stamp, Twist)>>,
}

impl<'a> Velocities<'a> {
    /// The velocities of keyframes. The velocities of test keyframes are included, although their
    /// pixels are not used.
    pub(super) fn of(keyframes: &'a [Arc<Keyframe>]) -> Self {
        let mut by_camera = BTreeMap::<&str, Vec<(Stamp, Twist)>>::new();
        for keyframe in keyframes {
            if let Some(twist) = keyframe.twist {
                let velocities = by_camera.entry(&keyframe.camera).or_default();
                velocities.push((keyframe.stamp, twist));
            }
        }
        for velocities in by_camera.values_mut() {
            velocities.sort_by_key(|(stamp, _)| *stamp);
            velocities.dedup_by_key(|(stamp, _)| *stamp);
        }
        Self { by_camera }
    }

    /// Changes the velocities of images so that the time offsets of these corrections give poses
    /// that are correct up to the second order of the offset. Returns false if nothing changes,
    /// because all offsets are small.
    pub(super) fn apply_to(&self, images: &mut [PreparedImage], corrections: &Corrections) -> bool {
        let mut has_changed = false;
        for image in images {
            let offset_secs = corrections.by_camera[image.camera].time_offset_secs;
            if offset_secs.abs() < MIN_OFFSET_SECS {
                continue;
            }
            if let Some(twist) = self.mean_twist(&image.keyframe, offset_secs) {
                image.keyframe = Arc::new(Keyframe {
                    twist: Some(twist),
                    ..(*image.keyframe).clone()
                });
                has_changed = true;
            }
        }
        has_changed
    }

    /// The constant velocity that moves the camera of a keyframe within the time offset exactly as
    /// the accelerated motion does. `None` if the acceleration is not known.
    ///
    /// A pose has the velocity `(v, w)` in its own axes, which changes by `(v', w')` per second.
    /// Within the time t, it moves by the exponential of `t (v, w) + t²/2 (v', w')`, up to the
    /// third order (Magnus 1954). Corrections apply the inverse of this motion as the rotation `-t
    /// w` and the translation `-t v`. The exponential of the inverse has the translation `-t v -
    /// t²/2 v' + t²/2 w x v`, so `v` is replaced by `v + t/2 (v' - w x v)`.
    fn mean_twist(&self, keyframe: &Keyframe, offset_secs: f64) -> Option<Twist> {
        let twist = keyframe.twist?;
        let rate = self.rate_at(&keyframe.camera, keyframe.stamp)?;
        let half_secs = 0.5 * offset_secs;
        let turning = twist.angular_rad_s.cross(&twist.linear_m_s);
        Some(Twist {
            linear_m_s: twist.linear_m_s + half_secs * (rate.linear_m_s - turning),
            angular_rad_s: twist.angular_rad_s + half_secs * rate.angular_rad_s,
        })
    }

    /// Change of the velocity of a camera at one of its images, per second. It is the derivative of
    /// the parabola through the velocities at this image and its two neighbors. At the end of a
    /// sequence, it is the difference quotient to the only neighbor.
    fn rate_at(&self, camera: &str, stamp: Stamp) -> Option<Twist> {
        let velocities = self.by_camera.get(camera)?;
        let ix = velocities
            .binary_search_by_key(&stamp, |(stamp, _)| *stamp)
            .ok()?;
        let quotient_from = |first: Option<usize>| {
            let first = first?;
            let (start, before) = velocities.get(first)?;
            let (end, after) = velocities.get(first + 1)?;
            let secs = end.secs_since(*start);
            (secs <= MAX_GAP_SECS).then(|| (secs, weighted(after, 1.0 / secs, before, -1.0 / secs)))
        };
        match (quotient_from(ix.checked_sub(1)), quotient_from(Some(ix))) {
            (Some((before_secs, before)), Some((after_secs, after))) => {
                // The nearer neighbor has more weight.
                let share = after_secs / (before_secs + after_secs);
                Some(weighted(&before, share, &after, 1.0 - share))
            }
            (Some((_, quotient)), None) | (None, Some((_, quotient))) => Some(quotient),
            (None, None) => None,
        }
    }
}

/// A weighted sum of two twists.
fn weighted(one: &Twist, weight: f64, other: &Twist, other_weight: f64) -> Twist {
    Twist {
        linear_m_s: one.linear_m_s * weight + other.linear_m_s * other_weight,
        angular_rad_s: one.angular_rad_s * weight + other.angular_rad_s * other_weight,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CameraCorrection;
    use crate::scenes::{Miscalibration, camera_at, capture, joints_at};

    #[test]
    fn accelerated_motion_is_correct_up_to_the_second_order() {
        const OFFSET_SECS: f64 = 0.03;
        // The images of this scan are 0.3 s apart, so the acceleration has an error of a few
        // percent.
        const MAX_ERROR_RATIO: f64 = 0.25;
        let keyframes = capture(&Miscalibration {
            time_offset_secs: OFFSET_SECS,
            ..Miscalibration::none()
        });
        let velocities = Velocities::of(&keyframes);
        let correction = CameraCorrection {
            time_offset_secs: OFFSET_SECS,
            ..CameraCorrection::default()
        };
        let (mut before_m, mut after_m) = (0.0, 0.0);
        let (mut before_rad, mut after_rad) = (0.0, 0.0);
        for keyframe in &keyframes {
            // The stamps of the images are true, and their poses are late.
            let truth = camera_at(joints_at(keyframe.stamp.secs(), false));
            let changed = Keyframe {
                twist: velocities.mean_twist(keyframe, OFFSET_SECS),
                ..(**keyframe).clone()
            };
            let errors = [&**keyframe, &changed].map(|keyframe| {
                let error = truth.inverse() * correction.apply(keyframe).world_from_camera;
                (error.translation.vector.norm(), error.rotation.angle())
            });
            before_m += errors[0].0;
            after_m += errors[1].0;
            before_rad += errors[0].1;
            after_rad += errors[1].1;
        }
        assert!(
            after_m < MAX_ERROR_RATIO * before_m && after_rad < MAX_ERROR_RATIO * before_rad,
            "{before_m} m and {before_rad} rad before, {after_m} m and {after_rad} rad after"
        );
    }

    #[test]
    fn acceleration_needs_neighbors_and_small_offsets_change_nothing() {
        let keyframes = capture(&Miscalibration::none());
        let middle = keyframes[20].stamp;
        let rate = |keyframes: &[Arc<Keyframe>]| Velocities::of(keyframes).rate_at("wrist", middle);
        assert!(rate(&keyframes).is_some() && rate(&keyframes[20..]).is_some());
        assert!(rate(&keyframes[20..21]).is_none() && rate(&keyframes[..20]).is_none());
        let mut images: Vec<PreparedImage> = keyframes[..2]
            .iter()
            .filter_map(|keyframe| PreparedImage::new(keyframe, 0))
            .collect();
        let velocities = Velocities::of(&keyframes);
        let mut corrections = Corrections::none(1);
        assert!(!velocities.apply_to(&mut images, &corrections));
        corrections.by_camera[0].time_offset_secs = 0.02;
        assert!(velocities.apply_to(&mut images, &corrections));
        assert_ne!(images[0].keyframe.twist, keyframes[0].twist);
    }
}
