//! Where the cameras of the keyframes were, and where they looked.

use crate::scene_hint;
use calibration::CalibratedCamera;
use keyframe::{Keyframe, Split};
use nalgebra::{Point3, Vector3};
use numbers::quantile::{Rank, quantile};
use std::sync::Arc;
use trainer::AlignedModel;

/// Number of depth pixels from which the median is taken.
const MAX_DEPTH_SAMPLES: usize = 500;
/// Minimum distance at which a camera without depth is assumed to look, in radii of the scene.
const MIN_DISTANCE_RADII: f64 = 0.2;

/// The places that keyframes show, in world.
pub(super) struct SeenPlaces {
    /// The point nearest to all optical axes, meters.
    pub(super) center_m: [f64; 3],
    /// Mean distance of the cameras from the center, meters.
    pub(super) radius_m: f64,
    pub(super) cameras: Vec<SeenCamera>,
}

/// The camera of one keyframe, in world.
pub(super) struct SeenCamera {
    /// Position, meters.
    pub(super) eye_m: [f64; 3],
    /// Corners of the image at the median depth, in order around the image, meters.
    pub(super) corners_m: [[f64; 3]; 4],
    /// Whether the keyframe is a test image.
    pub(super) is_test: bool,
}

impl SeenPlaces {
    /// The places that these keyframes show, with the corrections of the model.
    pub(super) fn of(
        method: &mut AlignedModel,
        keyframes: &[Arc<Keyframe>],
    ) -> anyhow::Result<Option<Self>> {
        let lenses = keyframes
            .iter()
            .map(|keyframe| Ok(method.calibrated_camera(keyframe)?))
            .collect::<anyhow::Result<Vec<CalibratedCamera>>>()?;
        let poses: Vec<_> = lenses.iter().map(|lens| lens.world_from_camera).collect();
        let Some(center) = scene_hint::nearest_to_axes(&poses) else {
            return Ok(None);
        };
        let distances_m = poses
            .iter()
            .map(|pose| (center.coords - pose.translation.vector).norm());
        let radius_m = distances_m.sum::<f64>() / poses.len() as f64;
        let cameras = keyframes
            .iter()
            .zip(&lenses)
            .map(|(keyframe, lens)| {
                let eye = Point3::from(lens.world_from_camera.translation.vector);
                let axis = lens.world_from_camera.rotation * Vector3::z();
                let along_m = (center - eye).dot(&axis);
                let assumed_m = along_m.max(MIN_DISTANCE_RADII * radius_m);
                let depth_m = median_depth_m(keyframe).unwrap_or(assumed_m);
                seen_camera(keyframe, lens, depth_m)
            })
            .collect();
        Ok(Some(Self {
            center_m: center.coords.into(),
            radius_m,
            cameras,
        }))
    }
}

fn seen_camera(keyframe: &Keyframe, lens: &CalibratedCamera, depth_m: f64) -> SeenCamera {
    let [width, height] = keyframe.size_px.map(f64::from);
    let corner = |[u, v]: [f64; 2]| {
        let x = (u - lens.principal_px[0]) / lens.focal_px[0];
        let y = (v - lens.principal_px[1]) / lens.focal_px[1];
        let in_camera = Point3::from(Vector3::new(x, y, 1.0) * depth_m);
        (lens.world_from_camera * in_camera).coords.into()
    };
    SeenCamera {
        eye_m: lens.world_from_camera.translation.vector.into(),
        corners_m: [[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]].map(corner),
        is_test: keyframe.split == Split::Test,
    }
}

/// Median of the measured depth, meters; `None` without depth.
fn median_depth_m(keyframe: &Keyframe) -> Option<f64> {
    let depth_m = &keyframe.depth.as_ref()?.depth_m;
    let stride = depth_m.len().div_ceil(MAX_DEPTH_SAMPLES).max(1);
    let mut known: Vec<f64> = depth_m
        .iter()
        .step_by(stride)
        .copied()
        .filter(|z| *z > 0.0 && z.is_finite())
        .map(f64::from)
        .collect();
    quantile(&mut known, 0.5, Rank::Lower)
}
