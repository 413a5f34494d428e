//! Keyframes without dense depth, until the live model has learned them.

use clearance_map::Posture;
use keyframe::Keyframe;
use parking_lot::Mutex;
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Time for which the model trains on a keyframe before it is drawn.
const LEARNING_TIME: Duration = Duration::from_secs(3);
/// Keyframes that may wait. When more arrive, the oldest one of all is dropped.
const MAX_WAITING: usize = 24;
/// Drawings have at most this many columns. The map needs no more for voxels of 2 cm.
const MAX_COLUMNS: u32 = 160;

/// A keyframe whose depth is to be drawn, subsampled, with the posture of the arm at its time.
#[derive(Clone, Debug)]
pub(crate) struct Undrawn {
    /// The keyframe without depth.
    pub(crate) keyframe: Keyframe,
    pub(super) posture: Posture,
    arrived: Instant,
}

/// Keyframes that wait to be drawn.
#[derive(Debug, Default)]
pub(super) struct UndrawnKeyframes(Mutex<VecDeque<Undrawn>>);

impl UndrawnKeyframes {
    /// Adds a keyframe that has just arrived.
    pub(super) fn push(&self, keyframe: &Keyframe, posture: Posture, now: Instant) {
        let mut waiting = self.0.lock();
        if waiting.len() == MAX_WAITING {
            waiting.pop_front();
        }
        waiting.push_back(Undrawn {
            keyframe: subsampled(keyframe),
            posture,
            arrived: now,
        });
    }

    /// The oldest keyframe, if the model has had time to learn it.
    pub(super) fn take_learned(&self, now: Instant) -> Option<Undrawn> {
        let mut waiting = self.0.lock();
        let is_learned = |oldest: &Undrawn| now.duration_since(oldest.arrived) >= LEARNING_TIME;
        waiting
            .front()
            .is_some_and(is_learned)
            .then(|| waiting.pop_front())?
    }
}

/// The center pixel of every square of pixels. As in [`keyframe::DepthMap::subsampled`], the squares
/// have an odd size, so that the rays stay the same.
fn subsampled(keyframe: &Keyframe) -> Keyframe {
    let stride = keyframe.size_px[0].div_ceil(MAX_COLUMNS) | 1;
    let [width, height] = keyframe.size_px.map(|size| size / stride);
    let pixels = keyframe.rgba_srgb.as_chunks::<4>().0;
    let at = |column: u32, row: u32| {
        let [column, row] = [column, row].map(|ix| ix * stride + stride / 2);
        pixels[(row * keyframe.size_px[0] + column) as usize]
    };
    let rgba_srgb = (0..height)
        .flat_map(|row| (0..width).map(move |column| (column, row)))
        .flat_map(|(column, row)| at(column, row))
        .collect();
    let scaled = |values_px: [f64; 2]| values_px.map(|px| px / f64::from(stride));
    Keyframe {
        size_px: [width, height],
        focal_px: scaled(keyframe.focal_px),
        principal_px: scaled(keyframe.principal_px),
        rgba_srgb,
        depth: None,
        truth: None,
        ..keyframe.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use keyframe::Split;
    use kinematics::{Stamp, Transform};
    use std::sync::Arc;

    fn keyframe(size_px: [u32; 2], nanos: i64) -> Keyframe {
        let n_px = (size_px[0] * size_px[1]) as usize;
        let byte = |ix: usize| u8::try_from(ix % 251).expect("below 256");
        Keyframe {
            camera: "front".into(),
            stamp: Stamp(nanos),
            size_px,
            focal_px: [300.0, 310.0],
            principal_px: [200.0, 120.0],
            rgba_srgb: (0..n_px).flat_map(|ix| [byte(ix), 0, 0, 255]).collect(),
            depth: None,
            world_from_camera: Transform::identity(),
            twist: None,
            readout_secs: 0.0,
            joint_twists: Arc::default(),
            base: None,
            split: Split::Train,
            truth: None,
            robot: None,
        }
    }

    fn posture() -> Posture {
        Posture {
            stamp: Stamp(0),
            position: Vec::new(),
            world_from_base: Transform::identity(),
        }
    }

    #[test]
    fn subsampled_keyframes_keep_their_rays_and_colors() {
        let full = keyframe([400, 240], 1);
        let small = subsampled(&full);
        assert_eq!(small.size_px, [133, 80]);
        small.check().expect("one color per pixel");
        let ray = |keyframe: &Keyframe, column: f64| {
            (column + 0.5 - keyframe.principal_px[0]) / keyframe.focal_px[0]
        };
        assert!((ray(&small, 10.0) - ray(&full, 31.0)).abs() < 1e-12);
        let red = |keyframe: &Keyframe, column: usize, row: usize| {
            keyframe.rgba_srgb[4 * (row * keyframe.size_px[0] as usize + column)]
        };
        assert_eq!(red(&small, 10, 20), red(&full, 31, 61));
    }

    #[test]
    fn keyframes_wait_until_they_are_learned_and_are_bounded() {
        let waiting = UndrawnKeyframes::default();
        let began = Instant::now();
        for ix in 0..=MAX_WAITING {
            let nanos = i64::try_from(ix).expect("small");
            waiting.push(&keyframe([8, 6], nanos), posture(), began);
        }
        assert!(waiting.take_learned(began).is_none());
        let learned = began + LEARNING_TIME;
        let first = waiting.take_learned(learned).expect("it has waited");
        assert_eq!(first.keyframe.stamp, Stamp(1), "the oldest one was dropped");
        let n_left = std::iter::from_fn(|| waiting.take_learned(learned)).count();
        assert_eq!(n_left, MAX_WAITING - 1);
    }
}
