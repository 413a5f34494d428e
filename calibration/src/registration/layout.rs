//! The parameters to estimate, their order, and their scales.

use crate::ParamSet;
use keyframe::Keyframe;
use kinematics::Twist;
use nalgebra::Vector3;

/// Typical magnitudes of calibration errors. They set the damping of the solver and determine which
/// directions count as observable.
mod prior {
    pub(super) const ROTATION_RAD: f64 = 0.0175; // 1 degree.
    pub(super) const TRANSLATION_M: f64 = 0.005;
    pub(super) const TIME_OFFSET_SECS: f64 = 0.02;
    pub(super) const JOINT: f64 = 0.01; // Radians or meters.
    pub(super) const LENS: f64 = 0.01; // Fraction of the focal length.
    pub(super) const DEPTH_SCALE: f64 = 0.01;
    pub(super) const READOUT_SECS: f64 = 0.01;
}

/// One parameter to estimate. The first number is the index of the camera or joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CalibrationParam {
    /// Motion of a camera relative to its parent, in its own axes. Parts 0 to 2 are in meters, and
    /// parts 3 to 5 in radians.
    Extrinsics(usize, usize),
    /// Time offset of a camera, seconds.
    TimeOffset(usize),
    /// Offset of a joint that carries cameras, radians or meters.
    Joint(usize),
    /// Motion of the depth frame in the axes of its camera, with the same parts as the extrinsics.
    DepthPose(usize, usize),
    /// Parts 0 and 1 are the logarithms of the factors on the focal lengths. Parts 2 and 3 are the
    /// offset of the principal point in focal lengths.
    Lens(usize, usize),
    /// Logarithm of the factor on depth.
    DepthScale(usize),
    /// Change of the readout time of a camera, seconds.
    Readout(usize),
}

impl CalibrationParam {
    /// Typical magnitude, in the parameter's own unit.
    pub(super) fn scale(self) -> f64 {
        match self {
            Self::Extrinsics(_, part) | Self::DepthPose(_, part) if part < 3 => {
                prior::TRANSLATION_M
            }
            Self::Extrinsics(..) | Self::DepthPose(..) => prior::ROTATION_RAD,
            Self::TimeOffset(_) => prior::TIME_OFFSET_SECS,
            Self::Joint(_) => prior::JOINT,
            Self::Lens(..) => prior::LENS,
            Self::DepthScale(_) => prior::DEPTH_SCALE,
            Self::Readout(_) => prior::READOUT_SECS,
        }
    }
}

/// The parameters to estimate, in order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Layout {
    pub(super) params: Vec<CalibrationParam>,
    by_camera: Vec<CameraParamOffsets>,
    joints: Option<usize>,
}

/// For each kind of parameter of a camera, the index of the first parameter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct CameraParamOffsets {
    pub(super) extrinsics: Option<usize>,
    pub(super) time_offset: Option<usize>,
    pub(super) depth_pose: Option<usize>,
    pub(super) lens: Option<usize>,
    pub(super) depth_scale: Option<usize>,
    pub(super) readout: Option<usize>,
}

impl CameraParamOffsets {
    /// Motions of a camera in its own axes, per unit of each of its extrinsics and of its time
    /// offset. Each entry has the parameter index, the translation in meters and the rotation in
    /// radians.
    ///
    /// * `twist`: velocity of the camera in its own axes, if known.
    pub(super) fn motions(
        &self,
        twist: Option<&Twist>,
    ) -> Vec<(usize, Vector3<f64>, Vector3<f64>)> {
        let mut motions = Vec::new();
        if let Some(extrinsics) = self.extrinsics {
            motions.extend(
                (0..3).map(|axis| (extrinsics + axis, Vector3::ith(axis, 1.0), Vector3::zeros())),
            );
            motions.extend((0..3).map(|axis| {
                (
                    extrinsics + 3 + axis,
                    Vector3::zeros(),
                    Vector3::ith(axis, 1.0),
                )
            }));
        }
        if let (Some(time_offset), Some(twist)) = (self.time_offset, twist) {
            motions.push((time_offset, twist.linear_m_s, twist.angular_rad_s));
        }
        motions
    }
}

impl Layout {
    /// The parameters of a set that apply to some keyframes. Each keyframe is given with the index
    /// of its camera. A static camera has no time offset, and a camera without joints has no joint
    /// offsets.
    pub(super) fn new(set: ParamSet, images: &[(usize, &Keyframe)], n_cameras: usize) -> Self {
        let mut layout = Self::default();
        for camera in 0..n_cameras {
            let keyframes: Vec<&Keyframe> = images
                .iter()
                .filter(|image| image.0 == camera)
                .map(|image| image.1)
                .collect();
            let moves = keyframes.iter().any(|keyframe| {
                keyframe
                    .twist
                    .is_some_and(|twist| twist.linear_m_s.norm() + twist.angular_rad_s.norm() > 0.0)
            });
            let has_rolling_shutter =
                moves && keyframes.iter().any(|keyframe| keyframe.readout_secs > 0.0);
            // A parameter that changes no residual would be reported as unobservable, although the
            // user cannot make it observable.
            let has_time_offset = set.contains(ParamSet::TIME_OFFSET) && moves;
            let has_readout = set.contains(ParamSet::READOUT) && has_rolling_shutter;
            let offsets = CameraParamOffsets {
                extrinsics: layout.allocate(set.contains(ParamSet::EXTRINSICS), 6, |part| {
                    CalibrationParam::Extrinsics(camera, part)
                }),
                time_offset: layout
                    .allocate(has_time_offset, 1, |_| CalibrationParam::TimeOffset(camera)),
                depth_pose: layout.allocate(set.contains(ParamSet::DEPTH_POSE), 6, |part| {
                    CalibrationParam::DepthPose(camera, part)
                }),
                lens: layout.allocate(set.contains(ParamSet::LENS), 4, |part| {
                    CalibrationParam::Lens(camera, part)
                }),
                depth_scale: layout.allocate(set.contains(ParamSet::DEPTH_SCALE), 1, |_| {
                    CalibrationParam::DepthScale(camera)
                }),
                readout: layout.allocate(has_readout, 1, |_| CalibrationParam::Readout(camera)),
            };
            layout.by_camera.push(offsets);
        }
        let n_joints = images
            .iter()
            .map(|(_, keyframe)| keyframe.joint_twists.len())
            .max()
            .unwrap_or(0);
        if set.contains(ParamSet::JOINTS) && n_joints > 0 {
            layout.joints = Some(layout.params.len());
            layout
                .params
                .extend((0..n_joints).map(CalibrationParam::Joint));
        }
        layout
    }

    /// Appends `n` parameters, if `is_on`, and returns the index of the first.
    fn allocate(
        &mut self,
        is_on: bool,
        n: usize,
        param: impl Fn(usize) -> CalibrationParam,
    ) -> Option<usize> {
        let begin = self.params.len();
        if !is_on {
            return None;
        }
        self.params.extend((0..n).map(param));
        Some(begin)
    }

    /// The extrinsics of one camera.
    pub(super) fn extrinsics_of(camera: usize) -> Self {
        let mut by_camera = vec![CameraParamOffsets::default(); camera];
        by_camera.push(CameraParamOffsets {
            extrinsics: Some(0),
            ..CameraParamOffsets::default()
        });
        let params = (0..6)
            .map(|part| CalibrationParam::Extrinsics(camera, part))
            .collect();
        Self {
            params,
            by_camera,
            joints: None,
        }
    }

    pub(super) fn n(&self) -> usize {
        self.params.len()
    }

    pub(super) fn of_camera(&self, camera: usize) -> CameraParamOffsets {
        self.by_camera.get(camera).copied().unwrap_or_default()
    }

    /// Index of the first joint offset.
    pub(super) fn joints(&self) -> Option<usize> {
        self.joints
    }
}
