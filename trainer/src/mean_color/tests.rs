//! A registered method is created, trained, saved, loaded and resumed by its name alone.

use super::*;
use crate::test_scenes as scenes;
use crate::{AlignedModel, CommonOptions, ModelKind, ModelSpec, Projection, Resumed, load, resume};
use gpu::testing::test_gpu;
use kinematics::Transform;
use std::sync::Arc;

const SIZE_PX: [u32; 2] = [3, 2];

fn kind() -> ModelKind {
    ModelKind::from_name("mean-color").unwrap()
}

/// A keyframe of one gray level.
fn gray(stamp: i64, level: u8) -> Arc<Keyframe> {
    let [keyframe] = scenes::ring(&[scenes::floor()], nalgebra::Point3::origin(), 1)
        .try_into()
        .unwrap();
    let n_pixels = keyframe.rgba_srgb.len() / 4;
    let rgba_srgb = [level, level, level, 255].repeat(n_pixels).into();
    Arc::new(Keyframe {
        stamp: Stamp(stamp),
        rgba_srgb,
        split: Split::Train,
        ..(*keyframe).clone()
    })
}

fn rendered(model: &mut AlignedModel) -> Vec<u8> {
    let request = RenderRequest {
        world_from_camera: Transform::identity(),
        size_px: SIZE_PX,
        projection: Projection::Equirectangular,
        shutter: None,
        near_m: 0.01,
        far_m: 10.0,
        crop: None,
        edits: Arc::default(),
        background_srgb: [0.0; 3],
        appearance_of: None,
        depth: false,
    };
    model.model_mut().render(&request).unwrap().rgba_srgb
}

#[test]
fn registered_method_trains_saves_loads_and_resumes() {
    let gpu = test_gpu();
    let settings = [("rate", 0.25.into()), ("max_splats", 7.into())]; // The second one belongs to another method.
    let model_spec = ModelSpec::new(kind(), CommonOptions::default(), &settings).unwrap();
    let mut model = model_spec.start(gpu.clone()).unwrap();
    assert!(model.is_idle());
    let keyframes = [gray(1, 100), gray(2, 180)];
    keyframes
        .iter()
        .for_each(|keyframe| model.push(keyframe.clone()).unwrap());
    assert_eq!(model.step(3).unwrap(), 3);
    let checkpoint = model.checkpoint().unwrap().finish().unwrap();
    assert_eq!(model.step(60).unwrap(), 60);
    let level = rendered(&mut model)[0];
    assert!(
        (130..150).contains(&level),
        "the mean of 100 and 180: {level}"
    );
    assert_eq!(rendered(&mut model), [level, level, level, 255].repeat(6));

    let later = gray(3, 50);
    let all = [keyframes.as_slice(), &[later]].concat();
    let Resumed {
        model_spec: resumed_spec,
        method: mut resumed,
        untrained,
        ..
    } = resume(gpu.clone(), &checkpoint, &all).unwrap();
    assert_eq!((resumed_spec, untrained.len()), (model_spec, 1));
    resumed.step(60).unwrap();
    let [uninterrupted, interrupted] =
        [&mut model, &mut resumed].map(|model| model.checkpoint().unwrap().finish().unwrap());
    assert_eq!(uninterrupted, interrupted);

    let folder = tempfile::tempdir().unwrap();
    model.save(folder.path()).unwrap();
    for metadata in [true, false] {
        if !metadata {
            std::fs::remove_file(folder.path().join(METADATA_FILE)).unwrap();
        }
        let mut loaded = load(gpu.clone(), folder.path()).unwrap();
        assert_eq!(loaded.kind, kind());
        assert_eq!(rendered(&mut loaded.method), rendered(&mut model));
    }
    std::fs::write(folder.path().join(METADATA_FILE), "{").unwrap();
    assert!(matches!(
        load(gpu, folder.path()),
        Err(Error::ModelMetadata { .. })
    ));
}

#[test]
fn invalid_settings_are_rejected_before_training() {
    let error =
        ModelSpec::new(kind(), CommonOptions::default(), &[("rate", "fast".into())]).unwrap_err();
    assert!(error.to_string().contains("mean-color"), "{error}");
}
