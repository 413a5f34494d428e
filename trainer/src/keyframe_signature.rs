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
    /// Correction of the base pose, in the same order; `None` without a moving base.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    map_from_odom: Option<[f64; 7]>,
}

/// Maximum difference between a pose that was recorded and the same pose computed from another
/// correction of the base, meters or parts of a quaternion.
const MAX_ROUNDING: f64 = 1e-9;

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
            map_from_odom: keyframe
                .base
                .as_ref()
                .map(|base| to_xyz_xyzw(&base.map_from_odom)),
        }
    }

    /// The keyframe as it was recorded, if it differs only by a correction of the base. A run that
    /// was killed may have stored a keyframe whose pose was revised since the last checkpoint.
    fn with_recorded_base(&self, keyframe: &Keyframe) -> Option<Keyframe> {
        let recorded = from_xyz_xyzw(self.map_from_odom?);
        let now = keyframe.base.as_ref()?.map_from_odom;
        let mut moved = keyframe.with_base_correction(&(recorded * now.inverse()));
        let numbers = to_xyz_xyzw(&moved.world_from_camera);
        let mut pairs = numbers.iter().zip(&self.world_from_camera);
        if !pairs.all(|(a, b)| (a - b).abs() <= MAX_ROUNDING) {
            return None;
        }
        moved.world_from_camera = from_xyz_xyzw(self.world_from_camera);
        self.difference(&moved).is_none().then_some(moved)
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
    let mut by_name: HashMap<_, Vec<&Arc<Keyframe>>> = HashMap::new();
    for keyframe in keyframes
        .iter()
        .filter(|keyframe| keyframe.split != Split::Test)
    {
        let name = (&*keyframe.camera, keyframe.stamp.0);
        by_name.entry(name).or_default().push(keyframe);
    }
    let mut found: Vec<(Arc<Keyframe>, &Arc<Keyframe>)> = Vec::new();
    let mut missing: Vec<Arc<Keyframe>> = Vec::new();
    for expected in expected {
        let name = (expected.camera.as_str(), expected.stamp_nanos);
        let candidates = by_name.get(&name).map_or(&[][..], Vec::as_slice);
        let Some(last) = candidates.last() else {
            missing.push(Arc::new(expected.placeholder()));
            continue;
        };
        // If a keyframe was revised, the list may contain it several times, with different poses.
        let same = candidates
            .iter()
            .find(|keyframe| expected.difference(keyframe).is_none());
        let keyframe = same.unwrap_or(last);
        let Some(difference) = expected.difference(keyframe) else {
            found.push((Arc::clone(keyframe), *keyframe));
            continue;
        };
        match expected.with_recorded_base(keyframe) {
            Some(recorded) => found.push((Arc::new(recorded), *keyframe)),
            None => return Err(Error::CheckpointData(difference)),
        }
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
    let is_matched = |keyframe: &Arc<Keyframe>| {
        found
            .iter()
            .any(|(_, matched)| Arc::ptr_eq(matched, keyframe))
    };
    let others = keyframes
        .iter()
        .filter(|keyframe| !is_matched(keyframe))
        .cloned()
        .collect();
    Ok((found.into_iter().map(|(of, _)| of).collect(), others))
}

#[cfg(test)]
mod tests {
    use super::*;
    use keyframe::BaseState;
    use kinematics::Transform;

    fn keyframe() -> Keyframe {
        let placeholder = KeyframeSignature {
            camera: "wrist".to_owned(),
            stamp_nanos: 7,
            size_px: [4, 2],
            depth_size_px: None,
            focal_px: [3.0; 2],
            principal_px: [2.0, 1.0],
            world_from_camera: [0.1, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8],
            map_from_odom: None,
        }
        .placeholder();
        Keyframe {
            base: Some(BaseState {
                station: None,
                world_from_base: Transform::translation(1.0, 0.0, 0.0),
                map_from_odom: Transform::identity(),
                truth: None,
            }),
            ..placeholder
        }
    }

    #[test]
    fn keyframe_with_a_revised_base_is_found_with_its_recorded_pose() {
        let recorded = keyframe();
        let expected = [KeyframeSignature::of(&recorded)];
        let revision = Transform::new(
            nalgebra::Vector3::new(0.003, -0.002, 0.001),
            nalgebra::Vector3::new(0.001, 0.002, -0.004),
        );
        let revised = Arc::new(recorded.with_base_correction(&revision));
        let (found, others) =
            match_keyframes(&expected, std::slice::from_ref(&revised)).expect("a match");
        assert!(others.is_empty());
        assert_eq!(
            KeyframeSignature::of(&found[0]).world_from_camera,
            expected[0].world_from_camera
        );
        // If both versions are there, in any order, the recorded one is found.
        let recorded = Arc::new(recorded);
        for both in [[&recorded, &revised], [&revised, &recorded]] {
            let both = both.map(Arc::clone);
            let (found, others) = match_keyframes(&expected, &both).expect("a match");
            assert!(Arc::ptr_eq(&found[0], &recorded) && Arc::ptr_eq(&others[0], &revised));
        }
        // Any other difference remains an error.
        let moved = Arc::new(Keyframe {
            world_from_camera: revision * revised.world_from_camera,
            ..(*revised).clone()
        });
        assert!(matches!(
            match_keyframes(&expected, &[moved]),
            Err(Error::CheckpointData(_))
        ));
    }
}
