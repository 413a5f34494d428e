//! Which numbers are sought, in which order, and how large each may be.

use super::frame::Frame;
use crate::splat::TermSet;

/// How large an error may be before one would call it a mistake: what the solver damps towards, and the scale on which a
/// direction counts as seen or not.
mod prior {
    pub(super) const TURN_RAD: f64 = 0.0175; // 1 degree.
    pub(super) const SHIFT_M: f64 = 0.005;
    pub(super) const DELAY_SECS: f64 = 0.02;
    pub(super) const JOINT: f64 = 0.01; // Of a radian or metre.
    pub(super) const LENS: f64 = 0.01; // Of the focal length.
    pub(super) const DEPTH_SCALE: f64 = 0.01;
    pub(super) const READOUT_SECS: f64 = 0.01;
}

/// One number that is sought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Term {
    /// Motion of a camera on what carries it, in its own axes: 0 to 2 metres, 3 to 5 radians.
    Mount(usize, usize),
    /// Seconds.
    Delay(usize),
    /// Of all cameras the arm carries: radians or metres.
    Joint(usize),
    /// Motion of the depth frame in the axes of its camera, as for the mount.
    DepthPose(usize, usize),
    /// 0 and 1: logarithm of the factors on the focal lengths; 2 and 3: shift of the principal point in focal lengths.
    Lens(usize, usize),
    /// Logarithm of the factor on depth.
    DepthScale(usize),
    /// Seconds.
    Readout(usize),
}

impl Term {
    /// How large it may be, in its own unit.
    pub(super) fn scale(self) -> f64 {
        match self {
            Self::Mount(_, part) | Self::DepthPose(_, part) if part < 3 => prior::SHIFT_M,
            Self::Mount(..) | Self::DepthPose(..) => prior::TURN_RAD,
            Self::Delay(_) => prior::DELAY_SECS,
            Self::Joint(_) => prior::JOINT,
            Self::Lens(..) => prior::LENS,
            Self::DepthScale(_) => prior::DEPTH_SCALE,
            Self::Readout(_) => prior::READOUT_SECS,
        }
    }
}

/// The numbers that are sought, in order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Layout {
    pub(super) terms: Vec<Term>,
    by_camera: Vec<CameraTerms>,
    joints: Option<usize>,
}

/// Where the terms of a camera begin.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct CameraTerms {
    pub(super) mount: Option<usize>,
    pub(super) delay: Option<usize>,
    pub(super) depth_pose: Option<usize>,
    pub(super) lens: Option<usize>,
    pub(super) depth_scale: Option<usize>,
    pub(super) readout: Option<usize>,
}

impl Layout {
    /// The terms of a set that the frames have: a camera that never moves has no delay, one without joints no offsets.
    pub(super) fn new(set: TermSet, frames: &[Frame], n_cameras: usize) -> Self {
        let mut layout = Self::default();
        for camera in 0..n_cameras {
            let of = || frames.iter().filter(move |frame| frame.camera == camera).map(|frame| &frame.keyframe);
            let moves = of().any(|keyframe| {
                keyframe.twist.is_some_and(|twist| twist.linear_m_s.norm() + twist.angular_rad_s.norm() > 0.0)
            });
            let rolls = moves && of().any(|keyframe| keyframe.readout_secs > 0.0);
            let mut begin = |on: bool, n: usize, term: &dyn Fn(usize) -> Term| {
                let at = layout.terms.len();
                on.then(|| {
                    layout.terms.extend((0..n).map(term));
                    at
                })
            };
            layout.by_camera.push(CameraTerms {
                mount: begin(set.mount, 6, &|part| Term::Mount(camera, part)),
                delay: begin(set.delay && moves, 1, &|_| Term::Delay(camera)),
                depth_pose: begin(set.depth_pose, 6, &|part| Term::DepthPose(camera, part)),
                lens: begin(set.lens, 4, &|part| Term::Lens(camera, part)),
                depth_scale: begin(set.depth_scale, 1, &|_| Term::DepthScale(camera)),
                readout: begin(set.readout && rolls, 1, &|_| Term::Readout(camera)),
            });
        }
        let n_joints = frames.iter().map(|frame| frame.keyframe.joint_twists.len()).max().unwrap_or(0);
        if set.joints && n_joints > 0 {
            layout.joints = Some(layout.terms.len());
            layout.terms.extend((0..n_joints).map(Term::Joint));
        }
        layout
    }

    pub(super) fn n(&self) -> usize {
        self.terms.len()
    }

    pub(super) fn of_camera(&self, camera: usize) -> CameraTerms {
        self.by_camera.get(camera).copied().unwrap_or_default()
    }

    /// Where the joints' offsets begin.
    pub(super) fn joints(&self) -> Option<usize> {
        self.joints
    }
}
