//! Sets of calibration parameters.

use serde::{Deserialize, Serialize};

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
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct ParamSet: u16 {
        /// Extrinsics of each camera: rotation and translation relative to its parent (hand-eye if the parent is the
        /// flange).
        const EXTRINSICS = 1;
        /// Time by which the poses of each camera lag behind its images.
        const TIME_OFFSET = 1 << 1;
        /// Focal lengths and principal point of each camera.
        const LENS = 1 << 2;
        /// A small pose error of each image.
        const IMAGE_POSES = 1 << 3;
        /// Gains of red, green and blue of each image.
        const IMAGE_GAINS = 1 << 4;
        /// Offset added to the reading of each joint that carries a camera. Only alignment estimates this parameter
        /// and the following ones.
        const JOINTS = 1 << 5;
        /// Pose of the depth frame in the camera frame.
        const DEPTH_POSE = 1 << 6;
        /// Factor on depth readings.
        const DEPTH_SCALE = 1 << 7;
        /// Time from the exposure of the first row to that of the last row.
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
        let names: Vec<&str> = NAMES.iter().filter(|(param, _)| self.contains(*param)).map(|(_, name)| *name).collect();
        f.write_str(&if names.is_empty() { "nothing".to_owned() } else { names.join(", ") })
    }
}
