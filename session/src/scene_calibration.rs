//! Calibration of a rig's cameras from images of a static scene, without a target.

use crate::corrected_rig;
use crate::training_options::{Refine, TrainingOptions};
use crate::{Data, Error};
use calibration::Alignment;
use capture::config::Rig;
use keyframe::{Keyframe, Split, counted};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Result of the calibration.
#[derive(Debug)]
pub struct SceneCalibration {
    /// Estimates with their standard deviations, and the trials that accepted or rejected them.
    pub alignment: Alignment,
    /// The rig with the accepted corrections; `None` if the data have no rig file.
    pub rig: Option<Rig>,
    /// Why the extrinsics cannot be determined; `None` if they can.
    pub refused: Option<String>,
}

/// Estimates calibration parameters from keyframes: those of `params`, or with [`Refine::Auto`] all that improve the
/// prediction of validation images.
///
/// Test images are not needed here, so all images are used.
///
/// # Errors
///
/// If a parameter cannot be estimated from these data, or if too few images overlap.
pub fn calibrate_scene(data: &Data, params: &[Refine]) -> Result<SceneCalibration, Error> {
    let options = TrainingOptions { refine: params.to_vec(), ..TrainingOptions::default() };
    let choice = options.refining(data.available(), Refine::Auto)?.align;
    let keyframes: Vec<_> = data.keyframes.iter().map(with_its_use).collect();
    let Some(alignment) = calibration::align(&keyframes, &choice) else {
        let n_images = counted(data.keyframes.len() as u64, "image");
        let depth =
            if data.has_depth() { "" } else { " and have texture; without depth, at least 10 are needed per camera" };
        return Err(Error::InsufficientData(format!(
            "the cameras cannot be calibrated from {n_images}: too few of them show the same surfaces{depth}. Move the camera around the scene, and turn it about all of its axes"
        )));
    };
    let rig = data.rig.as_ref().map(|rig| corrected_rig::corrected(rig, Some(&alignment), &BTreeMap::new()));
    let refused = refusal(&alignment);
    Ok(SceneCalibration { rig: rig.transpose()?, alignment, refused })
}

/// A test keyframe becomes a training keyframe.
fn with_its_use(keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
    match keyframe.split {
        Split::Test => Arc::new(Keyframe { split: Split::Train, ..(**keyframe).clone() }),
        Split::Train | Split::Validation => keyframe.clone(),
    }
}

fn refusal(alignment: &Alignment) -> Option<String> {
    let of_cameras = alignment.unobservable.iter().filter(|direction| direction.only_extrinsics);
    let directions: Vec<String> = of_cameras.map(ToString::to_string).collect();
    (!directions.is_empty()).then(|| {
        format!(
            "the motion does not determine the {}; turn the camera about at least two axes, by 20 degrees or more",
            directions.join(", and not the ")
        )
    })
}
