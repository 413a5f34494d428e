use super::*;
use crate::scenes::{Miscalibration, capture, remaining, wrong_extrinsics};
use nalgebra::Vector3;
use numbers::random::Random;

const EXTRINSICS: ParamSet = ParamSet::EXTRINSICS;

/// A scan of the room without depth.
fn scan(miscalibration: &Miscalibration) -> Vec<Arc<Keyframe>> {
    let without_depth = |keyframe: &Arc<Keyframe>| {
        Arc::new(Keyframe {
            depth: None,
            ..(**keyframe).clone()
        })
    };
    capture(miscalibration).iter().map(without_depth).collect()
}

fn with_extrinsics(extrinsics: Transform) -> Miscalibration {
    Miscalibration {
        extrinsics,
        ..Miscalibration::none()
    }
}

/// An extrinsics error of 3 degrees and 15 mm.
fn large_error() -> Transform {
    Transform::new(
        Vector3::new(0.009, -0.009, 0.008),
        Vector3::new(0.03, 0.03, -0.03),
    )
}

fn try_extrinsics() -> CameraRefinement {
    CameraRefinement::AlwaysAndTry(EXTRINSICS, Vec::new())
}

#[test]
fn hidden_errors_are_found_with_any_number_of_threads() {
    for error in [wrong_extrinsics(), large_error()] {
        let keyframes = scan(&with_extrinsics(error));
        let with_threads = |n: usize| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(n)
                .build()
                .unwrap();
            pool.install(|| crate::align(&keyframes, &try_extrinsics()))
                .unwrap()
        };
        let alignment = with_threads(1);
        assert!(
            alignment.trials[0].kept && alignment.trials[0].gain_db > 1.0,
            "{:?}",
            alignment.trials
        );
        assert!(
            matches!(&alignment.estimates[..], [report::Estimate::HandEye(_)]),
            "{:?}",
            alignment.estimates
        );
        let (degrees, mm) = remaining(&alignment.corrections["wrist"], &error);
        assert!(degrees < 0.15 && mm < 4.0, "{degrees} degrees, {mm} mm");
        assert_eq!(alignment, with_threads(3));
    }
}

#[test]
fn rolling_shutters_do_not_bias_the_estimate() {
    for error in [Transform::identity(), wrong_extrinsics()] {
        let miscalibration = Miscalibration {
            has_rolling_shutter: true,
            ..with_extrinsics(error)
        };
        let alignment = crate::align(
            &scan(&miscalibration),
            &CameraRefinement::Always(EXTRINSICS),
        )
        .unwrap();
        let (degrees, mm) = remaining(&alignment.corrections["wrist"], &error);
        assert!(degrees < 0.1 && mm < 3.0, "{degrees} degrees, {mm} mm");
    }
}

#[test]
fn time_offsets_are_found_from_color() {
    let candidates = [EXTRINSICS, ParamSet::TIME_OFFSET, ParamSet::LENS].to_vec();
    let miscalibration = Miscalibration {
        time_offset_secs: 0.02,
        ..with_extrinsics(wrong_extrinsics())
    };
    let alignment = crate::align(
        &scan(&miscalibration),
        &CameraRefinement::Try(candidates.clone()),
    )
    .unwrap();
    let kept: Vec<bool> = alignment.trials.iter().map(|trial| trial.kept).collect();
    assert_eq!(kept, [true, true, false], "{:?}", alignment.trials);
    let correction = &alignment.corrections["wrist"];
    assert!(
        (correction.time_offset_secs - 0.02).abs() < 0.001,
        "{} s",
        correction.time_offset_secs
    );
    let (degrees, mm) = remaining(correction, &wrong_extrinsics());
    // The estimate neglects that the velocity changes within 20 ms. If the time offset is not
    // estimated, the errors are 0.77 degrees and 24 mm.
    assert!(degrees < 0.4 && mm < 10.0, "{degrees} degrees, {mm} mm");
    // Nothing is changed if nothing is wrong.
    let alignment = crate::align(
        &scan(&Miscalibration::none()),
        &CameraRefinement::Try(candidates),
    )
    .unwrap();
    assert!(!alignment.has_corrections(), "{:?}", alignment.trials);
}

/// If extrinsics are estimated, too, they absorb an error of the focal length. The reason is that a
/// scan at a constant distance from the scene hardly distinguishes a longer focal length from a
/// nearer camera.
#[test]
fn lenses_are_found_from_color_if_extrinsics_are_known() {
    let keyframes = scan(&Miscalibration {
        focal_frac: 0.03,
        ..Miscalibration::none()
    });
    let alignment = crate::align(&keyframes, &CameraRefinement::Try(vec![ParamSet::LENS])).unwrap();
    assert!(alignment.trials[0].kept, "{:?}", alignment.trials);
    let log_focal = alignment.corrections["wrist"].log_focal;
    assert!(
        log_focal.iter().all(|log| (log + 0.03).abs() < 0.004),
        "{log_focal:?}"
    );
}

#[test]
fn each_camera_has_its_own_error() {
    let errors = [wrong_extrinsics(), large_error()];
    let scans = errors.map(|error| scan(&with_extrinsics(error)));
    let image = |ix: usize| {
        let keyframe = &scans[ix % 2][ix];
        // Both cameras have test and validation images.
        let split = Split::of(ix / 2);
        Arc::new(Keyframe {
            camera: ["left", "right"][ix % 2].into(),
            split,
            ..(**keyframe).clone()
        })
    };
    let keyframes: Vec<_> = (0..scans[0].len()).map(image).collect();
    let alignment = crate::align(&keyframes, &try_extrinsics()).unwrap();
    for (camera, error) in ["left", "right"].into_iter().zip(errors) {
        let (degrees, mm) = remaining(&alignment.corrections[camera], &error);
        assert!(
            degrees < 0.2 && mm < 5.0,
            "{camera}: {degrees} degrees, {mm} mm"
        );
    }
}

#[test]
fn right_extrinsics_are_not_changed() {
    let alignment = crate::align(&scan(&Miscalibration::none()), &try_extrinsics()).unwrap();
    assert!(
        !alignment.has_corrections() && !alignment.trials[0].kept,
        "{:?}",
        alignment.trials
    );
}

#[test]
fn images_without_common_texture_give_no_result() {
    let keyframes = scan(&with_extrinsics(large_error()));
    let with_pixels = |pixel: &dyn Fn(&mut Random) -> u8| -> Vec<Arc<Keyframe>> {
        let image = |(ix, keyframe): (usize, &Arc<Keyframe>)| {
            let mut random = Random::new(ix as u64);
            let pixels = 0..keyframe.rgba_srgb.len() / 4;
            let rgba = pixels
                .flat_map(|_| [[pixel(&mut random); 3].as_slice(), &[255]].concat())
                .collect();
            Arc::new(Keyframe {
                rgba_srgb: rgba,
                ..(**keyframe).clone()
            })
        };
        keyframes.iter().enumerate().map(image).collect()
    };
    let flat = with_pixels(&|random| 128 + random.byte() % 4);
    let noise = with_pixels(&|random| random.byte());
    let tiny = |keyframe: &Arc<Keyframe>| {
        Arc::new(Keyframe {
            size_px: [2, 1],
            rgba_srgb: [255; 8].into(),
            ..(**keyframe).clone()
        })
    };
    let tiny = keyframes.iter().map(tiny).collect();
    for keyframes in [&flat, &noise, &tiny, &keyframes[..4].to_vec()] {
        let all = [EXTRINSICS, ParamSet::TIME_OFFSET, ParamSet::LENS].to_vec();
        for choice in [
            CameraRefinement::Always(EXTRINSICS),
            try_extrinsics(),
            CameraRefinement::Try(all),
        ] {
            assert_eq!(crate::align(keyframes, &choice), None);
        }
    }
}

#[test]
fn unobservable_translations_stay_at_zero() {
    let error = Transform::new(Vector3::new(0.009, -0.009, 0.008), Vector3::zeros());
    let keyframes = scan(&Miscalibration {
        azimuth_only: true,
        ..with_extrinsics(error)
    });
    let alignment = crate::align(&keyframes, &CameraRefinement::Always(EXTRINSICS)).unwrap();
    assert!(!alignment.unobservable.is_empty());
    let correction = &alignment.corrections["wrist"];
    assert!(
        Vector3::from(correction.translation_m).norm() < 0.005,
        "{correction:?}"
    );
    assert!(
        Vector3::from(correction.rotation_rad).norm() < 0.02,
        "{correction:?}"
    );
}

#[test]
fn only_requested_parameters_are_estimated() {
    let keyframes = scan(&with_extrinsics(large_error()));
    for choice in [
        CameraRefinement::Always(ParamSet::JOINTS),
        CameraRefinement::Try(vec![ParamSet::DEPTH_POSE]),
    ] {
        assert_eq!(crate::align(&keyframes, &choice), None);
    }
    let alignment = crate::align(
        &scan(&Miscalibration::none()),
        &CameraRefinement::Always(ParamSet::LENS),
    )
    .unwrap();
    assert!(
        matches!(&alignment.estimates[..], [report::Estimate::Lens { .. }]),
        "{:?}",
        alignment.estimates
    );
}

#[test]
fn images_without_velocity_have_no_time_offset() {
    let still = |keyframe: &Arc<Keyframe>| {
        Arc::new(Keyframe {
            twist: None,
            ..(**keyframe).clone()
        })
    };
    let keyframes: Vec<_> = scan(&Miscalibration::none()).iter().map(still).collect();
    let choice = CameraRefinement::Try(vec![EXTRINSICS, ParamSet::TIME_OFFSET]);
    let alignment = crate::align(&keyframes, &choice).unwrap();
    assert!(
        alignment.trials.len() == 1 && !alignment.has_corrections(),
        "{:?}",
        alignment.trials
    );
    assert_eq!(
        crate::align(&keyframes, &CameraRefinement::Always(ParamSet::TIME_OFFSET)),
        None
    );
}

#[test]
fn unobservable_extrinsics_stay_in_the_report_if_other_parameters_are_tried() {
    let miscalibration = Miscalibration {
        azimuth_only: true,
        ..Miscalibration::none()
    };
    let choice = CameraRefinement::Try(vec![EXTRINSICS, ParamSet::TIME_OFFSET]);
    let alignment = crate::align(&scan(&miscalibration), &choice).unwrap();
    assert_eq!(alignment.trials.len(), 2);
    assert!(
        alignment
            .unobservable
            .iter()
            .any(|direction| direction.moves_cameras == ["wrist"]),
        "{alignment:?}"
    );
}
