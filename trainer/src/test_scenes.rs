//! Model options and render requests for the scenes of known shapes.

use crate::model_options::ModelOptions;
use crate::tsdf::TsdfOptions;
use crate::{Method, Projection, RenderRequest};
use calibration::CalibratedCamera;
use keyframe::Keyframe;
pub(crate) use keyframe::scenes::*;
use kinematics::Transform;
use std::sync::Arc;

pub(crate) fn options() -> ModelOptions<TsdfOptions> {
    ModelOptions::from(TsdfOptions {
        voxel_m: Some(0.02),
        noise_per_m2: Some(1e-4),
        ..TsdfOptions::default()
    })
}

/// The camera of a keyframe with the corrections that the model learned.
pub(crate) fn calibrated_camera(model: &mut dyn Method, keyframe: &Keyframe) -> CalibratedCamera {
    let corrections = model.camera_corrections().unwrap();
    corrections.get(&*keyframe.camera).map_or_else(
        || CalibratedCamera::of(keyframe),
        |correction| correction.apply(keyframe),
    )
}

pub(crate) fn request(world_from_camera: Transform) -> RenderRequest {
    RenderRequest {
        world_from_camera,
        size_px: SIZE_PX,
        projection: Projection::Pinhole {
            focal_px: FOCAL_PX,
            principal_px: PRINCIPAL_PX,
        },
        shutter: None,
        near_m: 0.01,
        far_m: 100.0,
        crop: None,
        edits: Arc::default(),
        background_srgb: [0.0, 0.5, 1.0],
        appearance_of: None,
        depth: true,
    }
}
