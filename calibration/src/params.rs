//! Sets of calibration parameters.

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::collections::BTreeMap;

bitflags::bitflags! {
    /// The set of camera parameters to estimate.
    ///
    /// ```
    /// use calibration::ParamSet;
    ///
    /// let set = ParamSet::EXTRINSICS | ParamSet::LENS;
    /// assert!(set.contains(ParamSet::LENS) && !set.contains(ParamSet::READOUT));
    /// assert_eq!(set.to_string(), "extrinsics, lenses");
    /// ```
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
    pub struct ParamSet: u16 {
        /// Extrinsics of each camera: rotation and translation relative to its parent. If the
        /// parent is the flange, they are the hand-eye transform.
        const EXTRINSICS = 1;
        /// Time by which the poses of each camera lag behind its images.
        const TIME_OFFSET = 1 << 1;
        /// Focal lengths and principal point of each camera.
        const LENS = 1 << 2;
        /// A small pose error of each image.
        const IMAGE_POSES = 1 << 3;
        /// Gains of red, green and blue of each image.
        const IMAGE_GAINS = 1 << 4;
        /// Offset added to the readings of each joint that carries a camera. This parameter and the
        /// following parameters are estimated only by alignment.
        const JOINTS = 1 << 5;
        /// Pose of the depth frame in the camera frame.
        const DEPTH_POSE = 1 << 6;
        /// Factor on depth readings.
        const DEPTH_SCALE = 1 << 7;
        /// Time from the exposure of the first row to the exposure of the last row.
        const READOUT = 1 << 8;
    }
}

impl std::fmt::Display for ParamSet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        const NAMES: [(ParamSet, &str); 9] = [
            (ParamSet::EXTRINSICS, "extrinsics"),
            (ParamSet::TIME_OFFSET, "time offsets"),
            (ParamSet::LENS, "lenses"),
            (ParamSet::IMAGE_POSES, "image poses"),
            (ParamSet::IMAGE_GAINS, "image gains"),
            (ParamSet::JOINTS, "joint offsets"),
            (ParamSet::DEPTH_POSE, "depth poses"),
            (ParamSet::DEPTH_SCALE, "depth scales"),
            (ParamSet::READOUT, "readout times"),
        ];
        let names: Vec<&str> = NAMES
            .iter()
            .filter(|(param, _)| self.contains(*param))
            .map(|(_, name)| *name)
            .collect();
        f.write_str(&if names.is_empty() {
            "nothing".to_owned()
        } else {
            names.join(", ")
        })
    }
}

/// Serializes the set as a map. The keys are the names of all parameters in lower case. The values
/// are booleans that indicate whether the set contains the parameter.
impl Serialize for ParamSet {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let all = Self::all();
        serializer.collect_map(
            all.iter_names()
                .map(|(name, param)| (name.to_lowercase(), self.contains(param))),
        )
    }
}

impl<'de> Deserialize<'de> for ParamSet {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let params = BTreeMap::<String, bool>::deserialize(deserializer)?;
        let contained = params.into_iter().filter(|(_, is_contained)| *is_contained);
        Ok(contained
            .filter_map(|(name, _)| Self::from_name(&name.to_uppercase()))
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_are_maps_of_names_in_files() {
        let set = ParamSet::TIME_OFFSET | ParamSet::IMAGE_GAINS;
        let json = serde_json::to_string(&set).unwrap();
        assert_eq!(
            json,
            r#"{"extrinsics":false,"time_offset":true,"lens":false,"image_poses":false,"image_gains":true,"joints":false,"depth_pose":false,"depth_scale":false,"readout":false}"#
        );
        assert_eq!(serde_json::from_str::<ParamSet>(&json).unwrap(), set);
        assert_eq!(
            serde_json::from_str::<ParamSet>(r#"{"lens":true}"#).unwrap(),
            ParamSet::LENS
        );
    }
}
