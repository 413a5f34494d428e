//! Rules that every registered method must follow.

use super::*;
use crate::aligned::AlignedModel;
use crate::{CommonOptions, ModelSpec, load, resume, resume_without_missing, test_scenes};
use gpu::Gpu;
use gpu::testing::test_gpu;
use keyframe::Keyframe;
use std::collections::BTreeSet;
use std::sync::Arc;

#[test]
fn names_files_and_extensions_are_unique() {
    let is_unique = |words: Vec<&str>| words.iter().collect::<BTreeSet<_>>().len() == words.len();
    assert!(is_unique(
        ModelKind::ALL.iter().map(|kind| kind.name()).collect()
    ));
    assert!(is_unique(ModelKind::model_files().collect()));
    let single_files = ModelKind::ALL
        .iter()
        .filter_map(|kind| kind.entry().single_file);
    let extensions =
        single_files.flat_map(|single| [single.extensions, single.unsupported_extensions]);
    assert!(is_unique(extensions.flatten().copied().collect()));
    for kind in ModelKind::ALL {
        assert!(
            !kind.entry().files.is_empty(),
            "{kind:?}: a folder cannot be recognized"
        );
        assert_eq!(ModelKind::from_name(kind.name()), Some(*kind));
    }
    assert_eq!(ModelKind::from_name("mesh"), None);
}

#[test]
fn untrained_model_of_every_method_is_resumed_saved_and_recognized() {
    let gpu = test_gpu();
    for kind in ModelKind::ALL {
        let common = CommonOptions {
            seed: 5,
            n_planned_steps: 90,
            ..CommonOptions::default()
        };
        let mut model = ModelSpec::new(*kind, common.clone(), &[])
            .unwrap()
            .start(gpu.clone())
            .unwrap();
        let checkpoint = model.checkpoint().unwrap().finish().unwrap();
        assert_eq!(checkpoint.method, kind.name());
        let resumed = resume(gpu.clone(), &checkpoint, &[]).unwrap();
        assert_eq!(
            (resumed.model_spec.kind, &resumed.model_spec.options.common),
            (*kind, &common)
        );
        resumed.model_spec.check().unwrap();

        let folder = tempfile::tempdir().unwrap();
        model.save(folder.path()).unwrap();
        let written = std::fs::read_dir(folder.path()).unwrap();
        let written: BTreeSet<_> = written
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        let registered = kind
            .entry()
            .files
            .iter()
            .chain([&METADATA_FILE])
            .map(|file| (*file).to_owned());
        assert_eq!(written, registered.collect(), "{kind:?}");
        assert_eq!(ModelKind::of_saved(folder.path()).unwrap(), Some(*kind));
        assert_eq!(
            load(gpu.clone(), folder.path())
                .unwrap()
                .method
                .model_mut()
                .bounds()
                .unwrap(),
            None
        );
        std::fs::remove_file(folder.path().join(METADATA_FILE)).unwrap();
        assert_eq!(ModelKind::of_saved(folder.path()).unwrap(), Some(*kind));
        assert_eq!(
            load(gpu.clone(), folder.path())
                .unwrap()
                .method
                .model_mut()
                .bounds()
                .unwrap(),
            None
        );
    }
}

/// A model after two steps.
fn trained(kind: ModelKind, gpu: &Arc<Gpu>, keyframes: &[Arc<Keyframe>]) -> AlignedModel {
    let spec = ModelSpec::new(kind, CommonOptions::default(), &[]).unwrap();
    let mut model = spec.start(gpu.clone()).unwrap();
    for keyframe in keyframes {
        model.push(keyframe.clone()).unwrap();
    }
    while model.model().progress().step < 2 {
        model.step(1).unwrap();
    }
    model
}

/// A live run deletes the files of removed keyframes when it writes the next checkpoint.
#[test]
fn removed_keyframe_is_not_needed_to_resume() {
    let gpu = test_gpu();
    let keyframes = test_scenes::ring(&[test_scenes::floor()], nalgebra::Point3::origin(), 4);
    for kind in ModelKind::ALL {
        let mut model = trained(*kind, &gpu, &keyframes);
        let n_steps = model.model().progress().step;
        model
            .remove(&keyframes[0].camera, keyframes[0].stamp)
            .unwrap();
        assert_eq!(model.model().progress().step, n_steps, "{kind:?}");
        let checkpoint = model.checkpoint().unwrap().finish().unwrap();
        let resumed = resume(gpu.clone(), &checkpoint, &keyframes[1..]);
        assert!(resumed.is_ok(), "{kind:?}: {:?}", resumed.err());
    }
}

/// The file of a keyframe may be damaged or deleted.
#[test]
fn every_method_resumes_without_missing_keyframes() {
    let gpu = test_gpu();
    let keyframes = test_scenes::ring(&[test_scenes::floor()], nalgebra::Point3::origin(), 6);
    for kind in ModelKind::ALL {
        let mut model = trained(*kind, &gpu, &keyframes);
        let checkpoint = model.checkpoint().unwrap().finish().unwrap();
        let left = [&keyframes[..1], &keyframes[3..]].concat();
        let error = resume(gpu.clone(), &checkpoint, &left).err().unwrap();
        let expected = format!(
            "2 of its images are missing, the first is image {}",
            keyframes[1].stamp.0
        );
        assert!(error.to_string().contains(&expected), "{kind:?}: {error}");
        let (mut resumed, missing) =
            resume_without_missing(gpu.clone(), &checkpoint, &left).unwrap();
        let expected = [1, 2].map(|ix| (keyframes[ix].camera.clone(), keyframes[ix].stamp));
        assert_eq!(missing, expected, "{kind:?}");
        let n_before = resumed.method.model().progress().step;
        for _ in 0..4 {
            resumed.method.step(1).unwrap();
        }
        assert!(
            resumed.method.model().progress().step > n_before || resumed.method.is_idle(),
            "{kind:?}"
        );
        // A checkpoint of the resumed model does not need the removed keyframes.
        let checkpoint = resumed.method.checkpoint().unwrap().finish().unwrap();
        assert!(resume(gpu.clone(), &checkpoint, &left).is_ok(), "{kind:?}");
    }
}

#[test]
fn checkpoint_of_an_unknown_method_is_rejected() {
    let gpu = test_gpu();
    let checkpoint =
        model_files::checkpoint::Checkpoint::new("mesh", serde_json::json!({}), Vec::new());
    assert!(
        matches!(resume(gpu, &checkpoint, &[]), Err(Error::UnknownMethod { name }) if name == "mesh")
    );
}

#[test]
fn method_of_a_file_follows_from_its_extension() {
    let of = |name: &str| ModelKind::of_single_file(Path::new(name)).map(ModelKind::name);
    assert_eq!(
        [of("a.PLY"), of("a/b.spz"), of("c.splat")],
        [Some("splat"); 3]
    );
    assert_eq!(
        of("a.sog"),
        Some("splat"),
        "recognized, although not supported"
    );
    assert_eq!([of("a.glb"), of("ply")], [None; 2]);
}
