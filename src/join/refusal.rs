//! Why images did not become keyframes, counted.

use crate::print::counted;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Why an image did not become a keyframe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Refusal {
    /// The rig file has no camera of this name.
    UnknownCamera,
    /// Too many images waited for joint readings.
    QueueFull,
    /// No joint readings around the stamp, or no base pose.
    NoPose,
    /// The pose holds NaN or infinity.
    PoseNotFinite,
    /// The camera has not moved enough since its nearest keyframe.
    NotMoved,
    /// The predicted motion blur is too long.
    Blur,
    /// The predicted rolling-shutter shear is too large.
    Shear,
    /// The shutter rolls and the velocity of the camera is not known.
    ShearUnknown,
    /// The image does not decode.
    Undecodable,
    /// The image is too dark, too bright, or clipped.
    Exposure,
    /// The image is less sharp than its camera's images usually are.
    NotSharp,
}

impl Refusal {
    /// A word for programs.
    pub(crate) fn name(self) -> &'static str {
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

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::UnknownCamera => "camera not in the rig file",
            Self::QueueFull => "too many waited for joint readings",
            Self::NoPose => "no joint readings or pose of the base around the stamp",
            Self::PoseNotFinite => "pose is not a number",
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

/// What became of all images.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Colour images that came.
    pub(crate) images: u64,
    /// Images that became keyframes.
    pub(crate) accepted: u64,
    /// Keyframes that went again because the store was full.
    pub(crate) evicted: u64,
    /// Keyframes of cameras with depth that had to go without.
    pub(crate) without_depth: u64,
    /// Images that devices or queues lost before they came here.
    pub(crate) device_skipped: u64,
    /// Joint readings that were out of order, not numbers, or of another arm.
    pub(crate) joints_refused: u64,
    /// Base poses that were out of order or not numbers.
    pub(crate) base_poses_refused: u64,
    /// Turns of range scanners that were put into the world.
    pub(crate) range_scans: u64,
    /// Turns without base poses, of unknown scanners, or too many that waited.
    pub(crate) range_scans_refused: u64,
    /// Images refused, by reason.
    pub(crate) refused: BTreeMap<Refusal, u64>,
    /// Cameras that sent images and are not in the rig file.
    pub(crate) unknown_cameras: BTreeSet<Arc<str>>,
}

/// What becomes of samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SampleUse {
    /// They are recorded: every image counts.
    Recorded,
    /// They are looked at: live, an image that comes too fast is replaced by the next; in a replay, what the devices
    /// lost was told when the recording was made.
    Watched,
}

impl Counts {
    /// What was lost of what should have been kept, one sentence each.
    pub(crate) fn data_losses(&self, sample_use: SampleUse) -> Vec<String> {
        let mut data_losses = Vec::new();
        if sample_use == SampleUse::Recorded && self.device_skipped > 0 {
            data_losses.push(dropped_by_devices(self.device_skipped));
        }
        if let Some(n_undecodable) = self.refused.get(&Refusal::Undecodable) {
            data_losses.push(format!("{} did not decode", counted(*n_undecodable, "image")));
        }
        data_losses
    }

    pub(super) fn refuse(&mut self, why: Refusal) {
        *self.refused.entry(why).or_default() += 1;
    }
}

/// The loss of images before they came here.
fn dropped_by_devices(n_images: u64) -> String {
    let what = counted(n_images, "image");
    format!("{what} lost by the devices, or dropped because we were too slow for them")
}

impl std::fmt::Display for Counts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} of {}", counted(self.accepted, "keyframe"), counted(self.images, "image"))?;
        for (why, n) in &self.refused {
            write!(f, "; {n} {why}")?;
        }
        let rest = [
            (self.evicted, "evicted from the full store"),
            (self.without_depth, "without depth"),
            (self.device_skipped, "lost by devices"),
            (self.joints_refused, "joint readings refused"),
            (self.base_poses_refused, "base poses refused"),
            (self.range_scans, "range scans placed"),
            (self.range_scans_refused, "range scans refused"),
        ];
        for (n, what) in rest {
            if n > 0 {
                write!(f, "; {n} {what}")?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dropped_images_are_counted_once() {
        let mut counts = Counts { device_skipped: 2, ..Counts::default() };
        counts.refuse(Refusal::Undecodable);
        counts.refuse(Refusal::NotMoved);
        assert_eq!(counts.data_losses(SampleUse::Recorded).len(), 2);
        assert_eq!(counts.data_losses(SampleUse::Watched), ["1 image did not decode"]);
    }

    #[test]
    fn summary_lists_only_nonzero_counts() {
        let mut counts = Counts { images: 9, accepted: 4, device_skipped: 2, ..Counts::default() };
        counts.refuse(Refusal::NotMoved);
        counts.refuse(Refusal::NotMoved);
        counts.refuse(Refusal::Blur);
        assert_eq!(counts.to_string(), "4 keyframes of 9 images; 2 not moved; 1 motion blur; 2 lost by devices");
    }
}
