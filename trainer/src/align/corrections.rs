//! What was found so far, and how a step changes it.

use super::frame::Frame;
use super::layout::{Layout, Term};
use super::view::View;
use crate::splat::{CameraFix, moved};
use kinematics::{Transform, Twist, transform};
use nalgebra::{DVector, Vector3};
use rayon::prelude::*;

/// One fix a camera.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Corrections {
    pub(super) fixes: Vec<CameraFix>,
}

impl Corrections {
    pub(super) fn none(n_cameras: usize) -> Self {
        Self { fixes: vec![CameraFix::default(); n_cameras] }
    }

    /// The frames' cameras; every frame has depth.
    pub(super) fn views(&self, frames: &[Frame], layout: &Layout) -> Vec<View> {
        let view = |frame: &Frame| {
            View::new(frame, &self.fixes[frame.camera], layout).expect("a frame is made of a keyframe with depth")
        };
        frames.par_iter().map(view).collect()
    }

    /// The value of a term; the mount's as a motion of the camera, which is exact for small ones.
    pub(super) fn value(&self, term: Term) -> f64 {
        match term {
            Term::Mount(camera, part) if part < 3 => -self.fixes[camera].shift_m[part],
            Term::Mount(camera, part) => -self.fixes[camera].turn_rad[part - 3],
            Term::Delay(camera) => self.fixes[camera].delay_secs,
            Term::Joint(joint) => {
                self.fixes.iter().find_map(|fix| fix.joint_offsets.get(joint)).copied().unwrap_or(0.0)
            }
            Term::DepthPose(camera, part) if part < 3 => self.fixes[camera].depth_shift_m[part],
            Term::DepthPose(camera, part) => self.fixes[camera].depth_turn_rad[part - 3],
            Term::Lens(camera, part) if part < 2 => self.fixes[camera].log_focal[part],
            Term::Lens(camera, part) => self.fixes[camera].principal_focals[part - 2],
            Term::DepthScale(camera) => self.fixes[camera].log_depth_scale,
            Term::Readout(camera) => self.fixes[camera].readout_secs,
        }
    }

    /// Takes a step along the terms of a layout, in their units.
    pub(super) fn take(&mut self, layout: &Layout, step: &DVector<f64>) {
        for (ix, term) in layout.terms.iter().enumerate() {
            let change = step[ix];
            match *term {
                Term::Mount(camera, 0) => {
                    let fix = &mut self.fixes[camera];
                    let mount = transform::exp(&twist(step, ix), -1.0) * moved(fix.turn_rad.into(), fix.shift_m.into());
                    (fix.turn_rad, fix.shift_m) = parts(&mount);
                }
                Term::DepthPose(camera, 0) => {
                    let fix = &mut self.fixes[camera];
                    let before = moved(fix.depth_turn_rad.into(), fix.depth_shift_m.into());
                    (fix.depth_turn_rad, fix.depth_shift_m) = parts(&(transform::exp(&twist(step, ix), 1.0) * before));
                }
                Term::Mount(..) | Term::DepthPose(..) => {}
                Term::Delay(camera) => self.fixes[camera].delay_secs += change,
                Term::Joint(joint) => {
                    for fix in &mut self.fixes {
                        let n = fix.joint_offsets.len().max(joint + 1);
                        fix.joint_offsets.resize(n, 0.0);
                        fix.joint_offsets[joint] += change;
                    }
                }
                Term::Lens(camera, part) if part < 2 => self.fixes[camera].log_focal[part] += change,
                Term::Lens(camera, part) => self.fixes[camera].principal_focals[part - 2] += change,
                Term::DepthScale(camera) => self.fixes[camera].log_depth_scale += change,
                Term::Readout(camera) => self.fixes[camera].readout_secs += change,
            }
        }
    }
}

/// Six numbers of a step as a motion: metres, then radians.
pub(super) fn twist(step: &DVector<f64>, begin: usize) -> Twist {
    let part = |from: usize| Vector3::from_fn(|row, _| step[begin + from + row]);
    Twist { linear_m_s: part(0), angular_rad_s: part(3) }
}

/// Rotation vector and translation.
pub(super) fn parts(motion: &Transform) -> ([f64; 3], [f64; 3]) {
    (motion.rotation.scaled_axis().into(), motion.translation.vector.into())
}
