//! Estimates a hand-eye transform from the color images of a real arm. Skipped without the test
//! data.

use calibration::{Alignment, CameraRefinement, ParamSet, align, rigid_transform};
use keyframe::Keyframe;
use kinematics::Transform;
use nalgebra::Vector3;
use std::sync::Arc;

/// Name of the camera of a dataset.
const CAMERA: &str = "camera";

fn correction(alignment: &Alignment) -> Transform {
    let correction = &alignment.corrections[CAMERA];
    rigid_transform(
        correction.rotation_rad.into(),
        correction.translation_m.into(),
    )
}

#[test]
fn hidden_error_of_a_real_arm_is_removed() {
    let Some(folder) = test_support::data_folder("arm_scan") else {
        return;
    };
    let dataset = drivers::dataset::read(&folder).unwrap();
    let keyframes = capture::dataset::load(&dataset, None, 0.5, &|_| ())
        .unwrap()
        .keyframes;
    // The published transform itself has an error of about 0.4 degrees and 9 mm.
    let given = align(&keyframes, &CameraRefinement::Always(ParamSet::EXTRINSICS)).unwrap();
    for (translation_m, rotation_rad) in [
        ([0.009, -0.009, 0.008], [0.03, 0.03, -0.03]),
        ([-0.008, -0.008, 0.01], [-0.02, 0.045, 0.02]),
    ] {
        let error = Transform::new(Vector3::from(translation_m), Vector3::from(rotation_rad));
        let with_error = |keyframe: &Arc<Keyframe>| {
            let world_from_camera = keyframe.world_from_camera * error;
            Arc::new(Keyframe {
                world_from_camera,
                ..(**keyframe).clone()
            })
        };
        let wrong: Vec<_> = keyframes.iter().map(with_error).collect();
        let found = align(&wrong, &CameraRefinement::Try(vec![ParamSet::EXTRINSICS])).unwrap();
        assert!(found.trials[0].kept, "{:?}", found.trials);
        let left = correction(&given) * error * correction(&found).inverse();
        let (degrees, mm) = (
            left.rotation.angle().to_degrees(),
            1e3 * left.translation.vector.norm(),
        );
        assert!(degrees < 0.1 && mm < 1.5, "{degrees} degrees, {mm} mm");
    }
}
