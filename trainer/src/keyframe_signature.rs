//! Signatures that identify and verify the training keyframes of a model without their pixels.

use crate::Error;
use keyframe::{DepthMap, Keyframe, Split};
use kinematics::Stamp;
use kinematics::transform::{from_xyz_xyzw, to_xyz_xyzw};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::sync::Arc;

/// Identifies a keyframe without its pixels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct KeyframeSignature {
    camera: String,
    stamp_nanos: i64,
    size_px: [u32; 2],
    depth_size_px: Option<[u32; 2]>,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    /// Translation, then rotation as x, y, z, w.
    world_from_camera: [f64; 7],
}

impl KeyframeSignature {
    pub(crate) fn of(keyframe: &Keyframe) -> Self {
        Self {
            camera: keyframe.camera.to_string(),
            stamp_nanos: keyframe.stamp.0,
            size_px: keyframe.size_px,
            depth_size_px: keyframe.depth.as_ref().map(|depth| depth.size_px),
            focal_px: keyframe.focal_px,
            principal_px: keyframe.principal_px,
            world_from_camera: to_xyz_xyzw(&keyframe.world_from_camera),
        }
    }

    /// A keyframe without pixels that stands for the recorded keyframe.
    fn placeholder(&self) -> Keyframe {
        let world_from_camera = from_xyz_xyzw(self.world_from_camera);
        let depth = self.depth_size_px.map(|size_px| DepthMap {
            size_px,
            focal_px: self.focal_px,
            principal_px: self.principal_px,
            depth_m: [].into(),
            world_from_camera,
        });
        Keyframe {
            camera: self.camera.as_str().into(),
            stamp: Stamp(self.stamp_nanos),
            size_px: self.size_px,
            focal_px: self.focal_px,
            principal_px: self.principal_px,
            rgba_srgb: [].into(),
            depth,
            world_from_camera,
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::Train,
            truth: None,
            robot: None,
        }
    }

    /// Whether the keyframe has this camera and stamp.
    pub(crate) fn is_of(&self, camera: &str, stamp: Stamp) -> bool {
        self.camera == camera && self.stamp_nanos == stamp.0
    }

    /// Describes a difference between `keyframe` and the recorded keyframe. `None` if they match.
    fn difference(&self, keyframe: &Keyframe) -> Option<String> {
        let other = Self::of(keyframe);
        // Values are compared bit by bit. A pose that was estimated again is different data,
        // however similar it is, and training would not give the same model as an uninterrupted
        // run.
        let [[width, height], [other_width, other_height]] = [self.size_px, other.size_px];
        let problem = if self.size_px != other.size_px {
            format!("has {other_width}x{other_height} pixels, had {width}x{height}")
        } else if self.depth_size_px != other.depth_size_px {
            "has a different depth image".to_owned()
        } else if (self.focal_px, self.principal_px) != (other.focal_px, other.principal_px) {
            "has different intrinsics".to_owned()
        } else if self.world_from_camera != other.world_from_camera {
            "has a different pose".to_owned()
        } else {
            return None;
        };
        Some(format!(
            "image {} of camera {:?} {problem}",
            self.stamp_nanos, self.camera
        ))
    }
}

/// The matched keyframes in the expected order, and all other keyframes.
pub(crate) type MatchedAndOthers = (Vec<Arc<Keyframe>>, Vec<Arc<Keyframe>>);

/// Finds the expected keyframes. Fails if a keyframe differs or is missing. If keyframes are
/// missing, the error contains placeholders for them.
pub(crate) fn match_keyframes(
    expected: &[KeyframeSignature],
    keyframes: &[Arc<Keyframe>],
) -> Result<MatchedAndOthers, Error> {
    // A model is not trained on test keyframes. With another split, a training keyframe may have
    // become a test keyframe. Without this filter, the model would be trained on it.
    let by_name: HashMap<_, _> = keyframes
        .iter()
        .filter(|keyframe| keyframe.split != Split::Test)
        .map(|keyframe| ((&*keyframe.camera, keyframe.stamp.0), keyframe))
        .collect();
    let mut found: Vec<Arc<Keyframe>> = Vec::new();
    let mut missing: Vec<Arc<Keyframe>> = Vec::new();
    for expected in expected {
        let Some(keyframe) = by_name.get(&(expected.camera.as_str(), expected.stamp_nanos)) else {
            missing.push(Arc::new(expected.placeholder()));
            continue;
        };
        if let Some(difference) = expected.difference(keyframe) {
            return Err(Error::CheckpointData(difference));
        }
        found.push(Arc::clone(keyframe));
    }
    // All missing keyframes are listed, so that the caller can continue without them in one
    // attempt.
    if !missing.is_empty() {
        return Err(Error::MissingKeyframes {
            placeholders: missing,
        });
    }
    // Keyframes are compared by address and not by name. The other keyframes include test
    // keyframes, and a second keyframe with the same camera and stamp must not be lost.
    let is_matched =
        |keyframe: &Arc<Keyframe>| found.iter().any(|matched| Arc::ptr_eq(matched, keyframe));
    let others = keyframes
        .iter()
        .filter(|keyframe| !is_matched(keyframe))
        .cloned()
        .collect();
    Ok((found, others))
}
