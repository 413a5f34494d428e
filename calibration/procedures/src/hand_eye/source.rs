//! Samples of `fieldrig calibrate hand-eye` from a file, a recording or devices.

use super::samples_file::{Samples, SamplesFile};
use crate::host::Host;
use crate::scan::Scan;
use calibration::hand_eye::Setup;
use kinematics::{Chain, Intrinsics, Transform};
use messages::InsufficientData;
use nalgebra::DMatrix;
use targets::TargetSpec;

/// Where the samples come from.
pub(super) enum Source {
    File(SamplesFile),
    /// A recording or the devices of a rig.
    Scan {
        scan: Box<Scan>,
        target: TargetSpec,
    },
}

impl Source {
    pub(super) fn setup(&self) -> Setup {
        match self {
            Self::File(file) => file.setup,
            Self::Scan { scan, .. } => scan.setup(),
        }
    }

    pub(super) fn target(&self) -> Option<&TargetSpec> {
        match self {
            Self::File(file) => file.target.as_ref(),
            Self::Scan { target, .. } => Some(target),
        }
    }

    /// Number of samples, including samples whose image does not show the target.
    pub(super) fn n_samples(&self) -> usize {
        match self {
            Self::File(file) => file.len(),
            Self::Scan { scan, .. } => scan.n_images(),
        }
    }

    /// Kinematics of the arm, if the rig has one.
    pub(super) fn chain(&self) -> Option<&Chain> {
        match self {
            // A samples file may have joint values, but it has no robot description.
            Self::File(_) => None,
            Self::Scan { scan, .. } => scan.chain(),
        }
    }

    /// The given intrinsics. `None` without images.
    pub(super) fn intrinsics(
        &self,
        size_px: Option<[u32; 2]>,
    ) -> anyhow::Result<Option<Intrinsics>> {
        match (self, size_px) {
            // A rig file always has intrinsics, with their own image size.
            (Self::Scan { scan, .. }, _) => Ok(Some(scan.intrinsics().clone())),
            (Self::File(file), Some(size_px)) => Ok(file.intrinsics(size_px)?),
            (Self::File(_), None) => Ok(None),
        }
    }

    /// Covariance of the given intrinsics, if it is known.
    pub(super) fn intrinsics_covariance(
        &self,
        intrinsics: &Intrinsics,
    ) -> anyhow::Result<Option<DMatrix<f64>>> {
        Ok(match self {
            Self::Scan { scan, .. } => scan.intrinsics_covariance()?,
            Self::File(file) => file.intrinsics_covariance(intrinsics)?,
        })
    }

    /// Problems of the input that do not prevent a calibration.
    pub(super) fn warnings(&self) -> &[String] {
        match self {
            // Problems of a file were reported when it was read.
            Self::File(_) => &[],
            Self::Scan { scan, .. } => &scan.warnings,
        }
    }

    /// Detects the target in all images of a file. For a scan, this has already been done.
    pub(super) fn samples(&mut self, host: &dyn Host) -> anyhow::Result<Samples> {
        match self {
            Self::File(file) => file.detect(host),
            Self::Scan { scan, target } => {
                let (used, unused) = scan.samples(None);
                let size_px = Some(scan.intrinsics().size_px);
                let other_size = scan.other_size(target);
                Ok(Samples {
                    used,
                    unused,
                    other_size,
                    size_px,
                    photos: scan.take_photos(),
                })
            }
        }
    }

    /// Fails if there is no image, or if no image shows the target.
    pub(super) fn check(&self, samples: &Samples) -> anyhow::Result<()> {
        // More images show another board than the given target, so the given target is probably
        // wrong. A wrong target explains missing detections better than the errors below.
        if let Some(size) = samples.other_size.as_ref().filter(|size| size.prevails) {
            return Err(InsufficientData(size.text.clone()).into());
        }
        match self {
            Self::File(file) => Ok(file.check_detected(samples)?),
            Self::Scan { scan, .. } => Ok(scan.check()?),
        }
    }

    /// `parent_from_camera` of a rig file for an estimated pose.
    pub(super) fn rig_pose(&self, parent_from_camera: &Transform) -> Transform {
        match self {
            // Without a rig, the pose is relative to the flange or base.
            Self::File(_) => *parent_from_camera,
            Self::Scan { scan, .. } => scan.rig_pose(parent_from_camera),
        }
    }
}
