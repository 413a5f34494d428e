//! Reasons why images did not become keyframes, and their counts.

use crate::robot_masks::RobotCover;
use messages::counted;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The reason why an image did not become a keyframe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Rejection {
    /// The rig file has no camera of this name.
    UnknownCamera,
    /// Too many images waited for joint states.
    QueueFull,
    /// No joint states around the stamp, or no base pose.
    NoPose,
    /// The pose contains NaN or infinity.
    PoseNotFinite,
    /// The camera has not moved enough since its nearest keyframe.
    NotMoved,
    /// The predicted motion blur is too large.
    Blur,
    /// The predicted rolling-shutter shear is too large.
    Shear,
    /// The camera has a rolling shutter and its velocity is not known.
    ShearUnknown,
    /// The image does not decode.
    Undecodable,
    /// The image is too dark, too bright, or clipped.
    Exposure,
    /// The image is less sharp than recent images of its camera.
    NotSharp,
}

impl Rejection {
    /// The key in reports and protocols, such as `not_moved`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::UnknownCamera => "unknown_camera",
            Self::QueueFull => "queue_full",
            Self::NoPose => "no_pose",
            Self::PoseNotFinite => "pose_not_finite",
            Self::NotMoved => "not_moved",
            Self::Blur => "blur",
            Self::Shear => "shear",
            Self::ShearUnknown => "shear_unknown",
            Self::Undecodable => "undecodable",
            Self::Exposure => "exposure",
            Self::NotSharp => "not_sharp",
        }
    }
}

impl std::fmt::Display for Rejection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::UnknownCamera => "camera not in the rig file",
            Self::QueueFull => "too many images waiting for joint states",
            Self::NoPose => "no joint states or base pose around the stamp",
            Self::PoseNotFinite => "pose not finite",
            Self::NotMoved => "not moved",
            Self::Blur => "motion blur",
            Self::Shear => "rolling-shutter shear",
            Self::ShearUnknown => "rolling shutter at unknown velocity",
            Self::Undecodable => "does not decode",
            Self::Exposure => "badly exposed",
            Self::NotSharp => "not sharp",
        })
    }
}

/// Counts of all samples. They are printed as one line that lists the counts above 0.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Color images received.
    pub images: u64,
    /// Images that became keyframes.
    pub accepted: u64,
    /// Keyframes evicted from the full store.
    pub evicted: u64,
    /// Keyframes of depth cameras without depth.
    pub without_depth: u64,
    /// Images dropped by devices or queues before the join.
    pub device_skipped: u64,
    /// Number of these dropped images that were color images. Cameras with depth lose images of
    /// both kinds.
    pub color_skipped: u64,
    /// Joint readings that were out of order or not finite, or had the wrong number of joints.
    pub joints_rejected: u64,
    /// Joint readings that differ from the previous ones by more than the joints can move.
    pub joints_too_fast: u64,
    /// Base poses that were out of order or not finite.
    pub base_poses_rejected: u64,
    /// Range scans transformed to the world frame.
    pub range_scans: u64,
    /// Range scans that had no base poses, came from unknown scanners, or were dropped because too
    /// many were waiting.
    pub range_scans_rejected: u64,
    /// Images rejected, by reason.
    pub rejected: BTreeMap<Rejection, u64>,
    /// Cameras that sent images but are not in the rig file.
    pub unknown_cameras: BTreeSet<Arc<str>>,
    /// For each camera in whose images the robot is masked, the number of keyframes and the pixels
    /// that the robot covers in them.
    pub robot_cover: BTreeMap<Arc<str>, (u64, RobotCover)>,
}

/// Share of the image from which on the robot leaves too little of the scene, percent.
const LARGE_COVER_PERCENT: u64 = 80;

/// Purpose of the samples, which determines whether dropped images are a loss.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleUse {
    /// The samples are recorded: every image counts.
    Recorded,
    /// The samples are only processed. Dropped live images do not count, because the next image
    /// replaces them. In a replay, drops by devices were already reported when the recording was
    /// made.
    ProcessedOnly,
}

impl Counts {
    /// Messages about data that should have been kept but were lost. Each message is one sentence.
    #[must_use]
    pub fn data_losses(&self, sample_use: SampleUse) -> Vec<String> {
        let mut data_losses = Vec::new();
        // If there is no recording, images are only candidates, and a dropped image is replaced by
        // the next one.
        if sample_use == SampleUse::Recorded && self.device_skipped > 0 {
            data_losses.push(dropped_by_devices(self.device_skipped));
        }
        if self.joints_too_fast > 0 {
            let what = counted(self.joints_too_fast, "joint state");
            data_losses.push(format!(
                "{what} ignored, because the joints cannot move so fast"
            ));
        }
        if let Some(n_undecodable) = self.rejected.get(&Rejection::Undecodable) {
            data_losses.push(format!(
                "{} did not decode",
                counted(*n_undecodable, "image")
            ));
        }
        data_losses
    }

    /// What the masks of the robot cover in the images of a camera, in one sentence. `None` if it
    /// is not masked.
    pub(crate) fn robot_note(&self, camera: &str) -> Option<String> {
        let (_, cover) = self.robot_cover.get(camera)?;
        let percent = cover.percent();
        let advice = if percent >= LARGE_COVER_PERCENT {
            "; little of the scene is visible, so move the camera, or check its parent_from_camera"
        } else {
            ""
        };
        Some(format!(
            "camera {camera:?}: the robot covers {percent} % of the image on average and is masked{advice}"
        ))
    }

    /// Adds the cover of a keyframe. Returns the number of keyframes of this camera.
    pub(super) fn add_robot_cover(&mut self, camera: &Arc<str>, cover: RobotCover) -> u64 {
        let (n_images, sum) = self.robot_cover.entry(Arc::clone(camera)).or_default();
        *n_images += 1;
        sum.add(cover);
        *n_images
    }

    pub(super) fn reject(&mut self, why: Rejection) {
        *self.rejected.entry(why).or_default() += 1;
    }
}

/// Message about images dropped before the join.
fn dropped_by_devices(n_images: u64) -> String {
    let what = counted(n_images, "image");
    format!("{what} dropped by the devices, or because this computer was too slow")
}

impl std::fmt::Display for Counts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} of {}",
            counted(self.accepted, "keyframe"),
            counted(self.images, "image")
        )?;
        for (why, n) in &self.rejected {
            write!(f, "; {n} {why}")?;
        }
        let rest = [
            (self.evicted, "evicted from the full store"),
            (self.without_depth, "without depth"),
            (self.device_skipped, "dropped by devices"),
            (self.joints_rejected, "joint states rejected"),
            (self.joints_too_fast, "joint states that jump"),
            (self.base_poses_rejected, "base poses rejected"),
            (self.range_scans, "range scans transformed"),
            (self.range_scans_rejected, "range scans rejected"),
        ];
        for (n, what) in rest {
            if n > 0 {
                write!(f, "; {n} {what}")?;
            }
        }
        for note in self
            .robot_cover
            .keys()
            .filter_map(|name| self.robot_note(name))
        {
            write!(f, "; {note}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dropped_images_are_counted_once() {
        let mut counts = Counts {
            device_skipped: 2,
            ..Counts::default()
        };
        counts.reject(Rejection::Undecodable);
        counts.reject(Rejection::NotMoved);
        assert_eq!(counts.data_losses(SampleUse::Recorded).len(), 2);
        assert_eq!(
            counts.data_losses(SampleUse::ProcessedOnly),
            ["1 image did not decode"]
        );
    }

    #[test]
    fn summary_lists_only_nonzero_counts() {
        let mut counts = Counts {
            images: 9,
            accepted: 4,
            device_skipped: 2,
            ..Counts::default()
        };
        counts.reject(Rejection::NotMoved);
        counts.reject(Rejection::NotMoved);
        counts.reject(Rejection::Blur);
        assert_eq!(
            counts.to_string(),
            "4 keyframes of 9 images; 2 not moved; 1 motion blur; 2 dropped by devices"
        );
    }
}
