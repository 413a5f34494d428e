//! Sets of calibration parameters.

/// The set of camera parameters to estimate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct ParamSet {
    /// Extrinsics of each camera: rotation and translation relative to its parent (hand-eye if the parent is the
    /// flange).
    pub extrinsics: bool,
    /// Time by which the poses of each camera lag behind its images.
    pub time_offset: bool,
    /// Focal lengths and principal point of each camera.
    pub lens: bool,
    /// A small pose error of each image.
    pub image_poses: bool,
    /// Gains of red, green and blue of each image.
    pub image_gains: bool,
    /// Offset added to the reading of each joint that carries a camera. Only alignment estimates this parameter and
    /// the following ones.
    pub joints: bool,
    /// Pose of the depth frame in the camera frame.
    pub depth_pose: bool,
    /// Factor on depth readings.
    pub depth_scale: bool,
    /// Time from the exposure of the first row to that of the last row.
    pub readout: bool,
}

impl ParamSet {
    /// No parameters.
    pub const NONE: Self = Self {
        extrinsics: false,
        time_offset: false,
        lens: false,
        image_poses: false,
        image_gains: false,
        joints: false,
        depth_pose: false,
        depth_scale: false,
        readout: false,
    };

    /// Whether the set contains any parameter.
    pub fn any(self) -> bool {
        self != Self::NONE
    }

    /// Union of both sets.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            extrinsics: self.extrinsics || other.extrinsics,
            time_offset: self.time_offset || other.time_offset,
            lens: self.lens || other.lens,
            image_poses: self.image_poses || other.image_poses,
            image_gains: self.image_gains || other.image_gains,
            joints: self.joints || other.joints,
            depth_pose: self.depth_pose || other.depth_pose,
            depth_scale: self.depth_scale || other.depth_scale,
            readout: self.readout || other.readout,
        }
    }
}

impl std::fmt::Display for ParamSet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names = [
            (self.extrinsics, "extrinsics"),
            (self.time_offset, "time offsets"),
            (self.lens, "lenses"),
            (self.image_poses, "image poses"),
            (self.image_gains, "image gains"),
            (self.joints, "joint offsets"),
            (self.depth_pose, "depth poses"),
            (self.depth_scale, "depth scales"),
            (self.readout, "readout times"),
        ];
        let names: Vec<&str> = names.into_iter().filter(|(on, _)| *on).map(|(_, name)| name).collect();
        f.write_str(&if names.is_empty() { "nothing".to_owned() } else { names.join(", ") })
    }
}
