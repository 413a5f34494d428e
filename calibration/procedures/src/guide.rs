//! Guidance while devices are read. It shows what the images cover so far and what to do next.

use crate::host::CameraView;
use crate::images::{self, DetectedImage};
use calibration::LensCoverage;
use calibration::hand_eye::{HandEyeAdvice, HandEyeGuidance, Setup};
use capture::CalibrationImage;
use capture::config::{Camera, Parent};
use capture::open::approximate_intrinsics;
use drivers::Sample;
use kinematics::Transform;
use targets::TargetSpec;

/// What images are taken for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// The lens, which needs corners in all parts of the image and tilted targets.
    Lens,
    /// The pose of the camera on the robot, which needs rotations.
    HandEye,
}

/// Detects the target in each image as it arrives, and shows what to do next.
pub(crate) struct Guide<'a> {
    target: &'a TargetSpec,
    camera: &'a Camera,
    purpose: Purpose,
    shown: Box<dyn CameraView>,
    coverage: LensCoverage,
    base_from_flange: Vec<Transform>,
    detected: Vec<DetectedImage>,
}

impl<'a> Guide<'a> {
    pub(crate) fn new(
        target: &'a TargetSpec,
        camera: &'a Camera,
        purpose: Purpose,
        shown: Box<dyn CameraView>,
    ) -> Self {
        let mut guide = Self {
            target,
            camera,
            purpose,
            shown,
            coverage: LensCoverage::new(&approximate_intrinsics(camera)),
            base_from_flange: Vec::new(),
            detected: Vec::new(),
        };
        guide.show_coverage();
        // The first advice appears before any image and describes how to begin.
        let advice = guide.advice();
        guide.shown.advise(&advice);
        guide
    }

    /// Shows a sample if it is an image of the camera. Detects the target in the new images.
    pub(crate) fn update(&mut self, sample: &Sample, images: &[CalibrationImage]) {
        if let Sample::Image(image) = sample {
            self.shown.show_live(image);
        }
        self.detect(images);
    }

    fn detect(&mut self, images: &[CalibrationImage]) {
        // There is one detection per image, so the number of detections is the index of the first
        // new image.
        for image in &images[self.detected.len()..] {
            let detected = images::detect_in_image(image, self.target);
            let view = detected.board.as_ref().ok().map(|board| &board.view);
            // Images without the target are shown, too, because they often show why the target was
            // not found.
            self.shown.show_searched(image.size_px, &image.gray, view);
            let text = match &detected.board {
                Ok(board) => {
                    self.coverage.add(&board.view);
                    self.base_from_flange
                        .extend(image.arm.as_ref().map(|arm| arm.base_from_flange));
                    self.show_coverage();
                    self.advice()
                }
                // The reason why the target was not found replaces the advice, because the target
                // can still be moved.
                Err(reason) => format!("{}: {reason}", detected.name),
            };
            self.shown.advise(&text);
            self.detected.push(detected);
        }
    }

    /// Returns the detected target of every image.
    pub(crate) fn finish(mut self, images: &[CalibrationImage]) -> Vec<DetectedImage> {
        // Some images may have arrived after the last update.
        self.detect(images);
        self.shown.finish();
        self.detected
    }

    /// Shows what the images cover, if a lens is calibrated. The calibration of the pose of a
    /// camera does not depend on the coverage.
    fn show_coverage(&mut self) {
        if self.purpose == Purpose::Lens {
            self.shown.show_coverage(&self.coverage);
        }
    }

    fn advice(&self) -> String {
        let (so_far, advice, is_enough) = match self.purpose {
            Purpose::Lens => {
                let percent = 100.0 * self.coverage.covered_frac();
                let so_far = match self.coverage.n_images() {
                    1 => format!("1 image of the target covers {percent:.0} % of the image"),
                    n => format!("{n} images of the target cover {percent:.0} % of the image"),
                };
                (
                    so_far,
                    self.coverage.next().to_string(),
                    self.coverage.is_enough(),
                )
            }
            Purpose::HandEye => {
                let is_on_flange = self.camera.parent == Parent::Flange;
                // The moving body carries the camera or the target. Its rotations determine the
                // result.
                let (setup, body) = if is_on_flange {
                    (Setup::EyeInHand, "camera")
                } else {
                    (Setup::EyeToHand, "flange")
                };
                let guidance = HandEyeGuidance::new(
                    &self.base_from_flange,
                    setup,
                    &self.camera.parent_from_camera,
                );
                let [x, y, z] = guidance.span_deg;
                let so_far = format!(
                    "{} with the target, rotated by {x:.0}, {y:.0} and {z:.0} degrees about the {body}'s x, y and z axes",
                    messages::counted(guidance.n_poses as u64, "pose")
                );
                (
                    so_far,
                    guidance.advice.to_string(),
                    guidance.advice == HandEyeAdvice::Enough,
                )
            }
        };
        if is_enough {
            format!("{so_far}; {advice}: press Ctrl-C to calibrate")
        } else {
            format!("{so_far}; next: {advice}")
        }
    }
}
