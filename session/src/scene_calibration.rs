//! Calibration of a rig's cameras from images of a static scene, without a target.

use crate::Data;
use crate::corrected_rig;
use crate::training_options::{Refine, TrainingOptions};
use calibration::{
    Alignment, CameraRefinement, Candidate, Estimate, ExtrinsicsCovariance, HalvesAgreement,
    ParamSet, PoseSigmas,
};
use capture::config::{Parent, Rig};
use keyframe::{Keyframe, Split};
use kinematics::Transform;
use messages::{InsufficientData, Setting, counted};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Result of the calibration.
#[derive(Debug)]
pub struct SceneCalibration {
    /// Estimates with their standard deviations, and the trials that accepted or rejected them.
    pub alignment: Alignment,
    /// The rig with the accepted corrections; `None` without a rig. Cameras in `refused` keep their
    /// extrinsics.
    pub rig: Option<Rig>,
    /// Cameras that keep their extrinsics, because the motion does not determine them, or because
    /// the correction is not reliable, with the reason.
    pub refused: BTreeMap<String, String>,
}

impl SceneCalibration {
    /// Whether all cameras keep their extrinsics for such a reason.
    pub fn is_refused(&self, data: &Data) -> bool {
        data.keyframes
            .iter()
            .all(|keyframe| self.refused.contains_key(&*keyframe.camera))
    }

    /// Standard deviations of the pose of a camera in its parent frame, along and about the axes of
    /// the camera. `None` if its extrinsics were not estimated.
    pub fn sigmas(&self, camera: &str) -> Option<PoseSigmas> {
        self.covariance(&[camera])?.of_camera(camera)
    }

    /// Pose of a camera in the frame of the first camera with the same parent, by name. `None` for
    /// that camera, and without a rig.
    pub fn relative(&self, camera: &str) -> Option<RelativePose> {
        let cameras = &self.rig.as_ref()?.cameras;
        let camera = cameras.iter().find(|other| *other.name == *camera)?;
        // Cameras are ordered by name, so that the reference does not depend on the order in the
        // rig file.
        let same_parent = cameras.iter().filter(|other| other.parent == camera.parent);
        let first = same_parent
            .min_by_key(|other| &other.name)
            .filter(|first| first.name != camera.name)?;
        let first_from_camera = first.parent_from_camera.inverse() * camera.parent_from_camera;
        let covariance = self.covariance(&[&first.name, &camera.name]);
        let sigmas = covariance
            .and_then(|known| known.between(&first.name, &camera.name, &first_from_camera));
        Some(RelativePose {
            first: first.name.to_string(),
            first_from_camera,
            sigmas,
        })
    }

    /// The covariance, unless one of the cameras was refused.
    fn covariance(&self, cameras: &[&str]) -> Option<&ExtrinsicsCovariance> {
        let is_refused = cameras
            .iter()
            .any(|camera| self.refused.contains_key(*camera));
        self.alignment
            .extrinsics_covariance
            .as_ref()
            .filter(|_| !is_refused)
    }
}

/// Pose of a camera in the frame of another one with the same parent.
#[derive(Clone, Debug)]
pub struct RelativePose {
    /// Name of the other camera.
    pub first: String,
    /// The pose.
    pub first_from_camera: Transform,
    /// Standard deviations along and about the axes of the camera. `None` if they are unknown.
    pub sigmas: Option<PoseSigmas>,
}

/// The parameters that [`calibrate_scene`] can estimate, and `auto`.
pub const SCENE_PARAMS: [Refine; 8] = [
    Refine::Auto,
    Refine::Extrinsics,
    Refine::TimeOffset,
    Refine::Lens,
    Refine::Joints,
    Refine::DepthPose,
    Refine::DepthScale,
    Refine::Readout,
];

/// Estimates calibration parameters from keyframes. These are the parameters in `params`, or with
/// [`Refine::Auto`] all parameters that improve the prediction of validation images. Test images
/// are used for the estimation, too.
///
/// * `rig`: the rig to correct, without settings that only apply to these data.
///
/// # Errors
///
/// If a parameter cannot be estimated from these data, or if too few images overlap.
pub fn calibrate_scene(
    data: &Data,
    params: &[Refine],
    rig: Option<&Rig>,
) -> anyhow::Result<SceneCalibration> {
    let options = TrainingOptions {
        refine: params.to_vec(),
        ..TrainingOptions::default()
    };
    // The rules are the same as for training.
    let settings = options.estimating(Setting::Params, data.available(), Refine::Auto)?;
    let choice = without_image_poses(settings.align);
    // Nothing is scored here, so test images would be wasted.
    let keyframes: Vec<_> = data.keyframes.iter().map(for_calibration).collect();
    let Some(alignment) = calibration::align(&keyframes, &choice) else {
        let n_images = counted(data.keyframes.len() as u64, "image");
        let needed = if data.has_depth() {
            ""
        } else {
            " or have texture; without depth, each camera needs at least 10 images"
        };
        return Err(InsufficientData(format!(
            "the cameras cannot be calibrated from {n_images}: too few of them show the same surfaces{needed}. Move the camera around the scene, and turn it about all of its axes"
        ))
        .into());
    };
    let mut refused: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for direction in &alignment.unobservable {
        for camera in &direction.moves_cameras {
            refused
                .entry(camera.clone())
                .or_default()
                .push(direction.to_string());
        }
    }
    let mut reasons: BTreeMap<String, String> = BTreeMap::new();
    for (camera, directions) in refused {
        // The advice depends on where the camera is mounted.
        let in_rig = rig.and_then(|rig| rig.cameras.iter().find(|other| *other.name == *camera));
        reasons.insert(camera, refusal(&directions, in_rig));
    }
    for (camera, reason) in unreliable(&alignment, &keyframes, &choice) {
        if choice.always().contains(ParamSet::EXTRINSICS) {
            // Parameters that the user names have no acceptance test.
            log::warn!("the pose of camera {camera:?} may be wrong: {reason}");
        } else {
            reasons.entry(camera).or_insert(reason);
        }
    }
    for camera in without_depth(&keyframes) {
        let reason = "it has no depth, and cameras with depth are calibrated without it. Use a target, or a recording \
                      of cameras without depth only";
        reasons.entry(camera).or_insert_with(|| reason.to_owned());
    }
    let refused = reasons;
    let rig = rig
        .map(|given| corrected(given, &alignment, &refused))
        .transpose()?;
    Ok(SceneCalibration {
        alignment,
        rig,
        refused,
    })
}

/// Cameras without any depth, if other cameras have depth.
fn without_depth(keyframes: &[Arc<Keyframe>]) -> BTreeSet<String> {
    let (with, without): (Vec<_>, Vec<_>) = keyframes
        .iter()
        .partition(|keyframe| keyframe.depth.is_some());
    let names = |keyframes: Vec<&Arc<Keyframe>>| -> BTreeSet<String> {
        let names = keyframes.iter().map(|keyframe| keyframe.camera.to_string());
        names.collect()
    };
    let with = names(with);
    if with.is_empty() {
        return BTreeSet::new();
    }
    &names(without) - &with
}

/// Cameras with a significant correction of their extrinsics that does not hold for their own
/// images, or for both halves of the images, with the reason.
fn unreliable(
    alignment: &Alignment,
    keyframes: &[Arc<Keyframe>],
    choice: &CameraRefinement,
) -> BTreeMap<String, String> {
    let corrected = significantly_moved(alignment);
    if corrected.is_empty() {
        return BTreeMap::new();
    }
    let trial = alignment
        .trials
        .iter()
        .rfind(|trial| has_extrinsics(trial.candidate));
    let set = accepted_params(alignment, choice);
    // Other parameters have the same errors in both halves.
    let halves = calibration::compare_halves(keyframes, set);
    let mut reasons = BTreeMap::new();
    for camera in corrected {
        let own_gain = trial.and_then(|trial| trial.is_significant_for(camera));
        let reason = match (own_gain, halves.get(camera)) {
            (Some(false), _) => Some(
                "its own validation images do not gain more than twice the standard error"
                    .to_owned(),
            ),
            (_, Some(agreement)) => disagreement(agreement),
            (_, None) => {
                log::warn!(
                    "camera {camera:?}: too few images to check that two halves of them give the same pose; record at \
                     least twice as many"
                );
                None
            }
        };
        reasons.extend(reason.map(|reason| (camera.to_owned(), reason)));
    }
    reasons
}

/// Names of the cameras whose extrinsics were corrected by more than three standard deviations.
fn significantly_moved(alignment: &Alignment) -> Vec<&str> {
    const MIN_SIGMAS: f64 = 3.0;
    let moved = alignment.estimates.iter().filter_map(|estimate| {
        let Estimate::HandEye(pose) = estimate else {
            return None;
        };
        let is_moved = pose.rotation_rad > MIN_SIGMAS * pose.rotation_sigma_rad
            || pose.translation_m > MIN_SIGMAS * pose.translation_sigma_m;
        is_moved.then_some(pose.camera.as_str())
    });
    moved.collect()
}

fn has_extrinsics(candidate: Candidate) -> bool {
    matches!(candidate, Candidate::Cameras(set) if set.contains(ParamSet::EXTRINSICS))
}

/// The parameters of the accepted model.
fn accepted_params(alignment: &Alignment, choice: &CameraRefinement) -> ParamSet {
    let kept = alignment.trials.iter().filter(|trial| trial.kept);
    kept.fold(choice.always(), |set, trial| match trial.candidate {
        Candidate::Cameras(params) => set | params,
        Candidate::Halved { .. } | Candidate::ShDegree { .. } => set,
    })
}

/// The reason why two halves of the images contradict each other. `None` if they agree.
fn disagreement(halves: &HalvesAgreement) -> Option<String> {
    (!halves.agrees()).then(|| {
        format!(
            "two halves of the images give poses that differ by {:.1} degrees and {:.0} mm, as much as the correction \
             itself; keep everything that moves out of view or mask it, and record more images",
            halves.difference_rad.to_degrees(),
            1e3 * halves.difference_m,
        )
    })
}

/// A rig file has no keys for the poses of images.
fn without_image_poses(choice: CameraRefinement) -> CameraRefinement {
    let without = |set: ParamSet| set - ParamSet::IMAGE_POSES;
    match choice {
        CameraRefinement::Always(set) => CameraRefinement::Always(without(set)),
        CameraRefinement::Try(sets) => CameraRefinement::Try(
            sets.into_iter()
                .map(without)
                .filter(|set| !set.is_empty())
                .collect(),
        ),
        CameraRefinement::AlwaysAndTry(set, sets) => CameraRefinement::AlwaysAndTry(
            without(set),
            sets.into_iter()
                .map(without)
                .filter(|set| !set.is_empty())
                .collect(),
        ),
        CameraRefinement::AlwaysAndWatch(set, watched) => {
            CameraRefinement::AlwaysAndWatch(without(set), without(watched))
        }
    }
}

/// The keyframe; test keyframes become training keyframes.
fn for_calibration(keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
    match keyframe.split {
        Split::Test => Arc::new(Keyframe {
            split: Split::Train,
            ..(**keyframe).clone()
        }),
        Split::Train | Split::Validation => keyframe.clone(),
    }
}

fn refusal(directions: &[String], camera: Option<&capture::config::Camera>) -> String {
    let advice = match camera.map(|camera| camera.parent) {
        None | Some(Parent::Flange) => {
            "turn the camera about at least two axes, by 20 degrees or more"
        }
        Some(Parent::Base) => {
            "a base that turns only about one axis cannot determine it; use a target"
        }
        Some(Parent::World) => {
            "the camera does not move, so it must see surfaces that moving cameras see, too"
        }
    };
    format!(
        "the motion does not determine: {}; {advice}",
        directions.join("; ")
    )
}

fn corrected(
    given: &Rig,
    alignment: &Alignment,
    refused: &BTreeMap<String, String>,
) -> anyhow::Result<Rig> {
    let mut rig = corrected_rig::corrected(given, Some(alignment), &BTreeMap::new())?;
    // An estimate along a direction that the motion does not determine is arbitrary. Other
    // corrections of the camera, such as its time offset, are kept.
    for (camera, before) in rig.cameras.iter_mut().zip(&given.cameras) {
        if refused.contains_key(&*camera.name) {
            camera.parent_from_camera = before.parent_from_camera;
        }
    }
    Ok(rig)
}

#[cfg(test)]
mod tests {
    use super::*;
    use calibration::Trial;
    use calibration::scenes::{Miscalibration, capture};

    fn trial(set: ParamSet, gains_db: &[f64]) -> Trial {
        let by_camera = gains_db.iter().map(|gain_db| ("fixed", *gain_db));
        Trial::of_gains(Candidate::Cameras(set), gains_db).with_cameras(by_camera)
    }

    #[test]
    fn accepted_parameters_are_those_of_kept_trials_and_of_the_request() {
        let alignment = Alignment {
            trials: vec![
                trial(ParamSet::EXTRINSICS, &[1.0, 1.1, 0.9, 1.0]),
                trial(ParamSet::LENS, &[0.1, -0.1, 0.2, -0.2]),
            ],
            ..Alignment::default()
        };
        let choice = CameraRefinement::AlwaysAndTry(ParamSet::TIME_OFFSET, Vec::new());
        assert_eq!(
            accepted_params(&alignment, &choice),
            ParamSet::EXTRINSICS | ParamSet::TIME_OFFSET
        );
        assert!(
            unreliable(&alignment, &[], &choice).is_empty(),
            "no camera was moved"
        );
    }

    #[test]
    fn cameras_without_depth_are_named_beside_cameras_with_depth() {
        let keyframe = |camera: &str, has_depth: bool| {
            let mut keyframe = (*capture(&Miscalibration::none())[0]).clone();
            keyframe.camera = camera.into();
            keyframe.depth = keyframe.depth.filter(|_| has_depth);
            Arc::new(keyframe)
        };
        // A depth image can be missing in some keyframes.
        let wrist = [keyframe("wrist", true), keyframe("wrist", false)];
        let overview = keyframe("overview", false);
        assert!(without_depth(&wrist).is_empty());
        assert!(without_depth(std::slice::from_ref(&overview)).is_empty());
        let both = [wrist.to_vec(), vec![overview]].concat();
        assert_eq!(
            without_depth(&both),
            BTreeSet::from(["overview".to_owned()])
        );
    }

    #[test]
    fn halves_that_differ_as_much_as_the_correction_are_a_reason() {
        let halves = |ratio| HalvesAgreement {
            ratio,
            difference_rad: 0.02,
            difference_m: 0.026,
        };
        assert_eq!(disagreement(&halves(100.0)), None);
        let reason = disagreement(&halves(1.5)).expect("a reason");
        assert!(reason.contains("1.1 degrees and 26 mm"), "{reason}");
    }
}
