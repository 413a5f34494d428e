//! Erased splats: pictures, chunks and exports without them, and floaters.

use super::SplatTrainer;
use super::training_tests::{keyframes, options, pose, request, scene, train};
use crate::floaters::Floaters;
use crate::method_entry::{ExportRequest, ExportWriter};
use crate::{ChunkLayout, Error, Method, ModelKind, ModelOptions, Picture};
use gpu::Gpu;
use gpu::testing::test_gpu;
use kinematics::Transform;
use model_files::Aabb;
use model_files::edits::{Edit, Edits};
use model_files::splat::arrays::SplatArrays;
use model_files::splat::{file, ply};
use nalgebra::Vector3;
use numbers::f32_of;
use numbers::random::Random;
use std::sync::Arc;

fn gpu() -> Arc<Gpu> {
    test_gpu()
}

fn model_of(arrays: &SplatArrays) -> SplatTrainer {
    SplatTrainer::from_arrays(gpu(), ModelOptions::default(), arrays).unwrap()
}

fn picture(model: &mut SplatTrainer, edits: &Arc<Edits>) -> Picture {
    let mut request = request(pose(1));
    request.edits = Arc::clone(edits);
    model.render(&request).unwrap()
}

fn is_same(one: &Picture, other: &Picture) -> bool {
    one.rgba_srgb == other.rgba_srgb && one.depth_m == other.depth_m
}

/// A part of the scene that is in view.
fn erased_box(at: [f64; 3]) -> Edit {
    let world_from_box = Transform::new(at.into(), Vector3::new(0.2, 0.4, -0.3));
    Edit::Box(Aabb {
        world_from_box,
        min_m: [-2.0, -2.5, -2.0],
        max_m: [2.0, 2.5, 2.0],
    })
}

fn edits_of(edits: impl IntoIterator<Item = Edit>) -> Arc<Edits> {
    let mut all = Edits::default();
    edits.into_iter().for_each(|edit| all.push(edit).unwrap());
    Arc::new(all)
}

fn find_floaters(model: &mut SplatTrainer, edits: &Arc<Edits>) -> Result<Floaters, Error> {
    model.find_floaters(edits)?.finish()
}

/// The scene with a small cluster of splats inside, far from the surface, and a single faint splat.
fn scene_with_floaters() -> SplatArrays {
    let mut arrays = scene();
    let n_scene = arrays.n_splats();
    let mut random = Random::new(5);
    for ix in 0..20 {
        let offset = [0; 3].map(|_| f32_of(0.03 * random.normal()));
        arrays
            .means
            .push([0.5 + offset[0], 0.3 + offset[1], 1.0 + offset[2]]);
        arrays.rotations_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        arrays.log_scales.push([-4.0; 3]);
        arrays.opacity_logits.push(3.0);
        arrays.sh.extend_from_within(16 * ix..16 * (ix + 1));
    }
    arrays.means.push([-1.0, 0.5, 2.0]);
    arrays.rotations_wxyz.push([1.0, 0.0, 0.0, 0.0]);
    arrays.log_scales.push([-2.0; 3]);
    arrays.opacity_logits.push(-2.0);
    arrays.sh.extend_from_within(0..16);
    assert_eq!(arrays.clone().checked().unwrap().n_splats(), n_scene + 21);
    arrays
}

#[test]
fn pictures_equal_those_of_a_model_without_the_erased_splats() {
    let arrays = scene();
    let mut model = model_of(&arrays);
    let whole = picture(&mut model, &Arc::default());
    let one = edits_of([erased_box([1.0, 0.0, 5.5])]);
    let two = edits_of([erased_box([1.0, 0.0, 5.5]), erased_box([-2.0, 0.5, 5.0])]);
    for edits in [&one, &two] {
        let left = arrays.clone().without_erased(edits);
        assert!(
            left.n_splats() < arrays.n_splats() && left.n_splats() > 300,
            "{} splats",
            left.n_splats()
        );
        let erased = picture(&mut model, edits);
        assert!(is_same(
            &erased,
            &picture(&mut model_of(&left), &Arc::default())
        ));
        let n_uncovered = erased
            .rgba_srgb
            .chunks_exact(4)
            .filter(|pixel| pixel[3] < 64)
            .count();
        assert!(
            n_uncovered > 100,
            "{n_uncovered} pixels show the background"
        );
    }
    assert!(
        is_same(&picture(&mut model, &Arc::default()), &whole),
        "after an undo"
    );
}

#[test]
fn training_and_scores_ignore_edits() {
    let gpu = gpu();
    let keyframes = keyframes(&gpu, true);
    let edits = edits_of([erased_box([1.0, 0.0, 5.5])]);
    let none = Arc::default();
    let mut trained = [false, true].map(|has_edits| {
        let mut trainer = SplatTrainer::new(gpu.clone(), options()).unwrap();
        keyframes
            .iter()
            .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
        for n_steps in [5, 10, 15] {
            picture(&mut trainer, if has_edits { &edits } else { &none });
            train(&mut trainer, n_steps);
        }
        trainer
    });
    let [without, with] = &mut trained;
    assert!(without.arrays().unwrap() == with.arrays().unwrap());
    let view = request(pose(0));
    assert_eq!(
        without.psnr(&view, &keyframes[0]).unwrap(),
        with.psnr(&view, &keyframes[0]).unwrap()
    );
}

#[test]
fn chunks_and_exports_lack_erased_splats() {
    let arrays = scene();
    let edits = edits_of([erased_box([1.0, 0.0, 5.5])]);
    let left = arrays.clone().without_erased(&edits);
    let mut model = model_of(&arrays);
    let mut n_in_chunks = |edits: &Arc<Edits>| -> usize {
        let chunks = model
            .queue_chunks(false, edits)
            .unwrap()
            .unwrap()
            .finish()
            .unwrap();
        let n_splats = |layout: &ChunkLayout| match layout {
            ChunkLayout::Splats { n_splats, .. } => *n_splats,
            ChunkLayout::Mesh { .. } => panic!("splats"),
        };
        chunks
            .chunks
            .iter()
            .map(|chunk| n_splats(&chunk.fine.layout))
            .sum()
    };
    assert_eq!(n_in_chunks(&edits), left.n_splats());
    assert_eq!(n_in_chunks(&Arc::default()), arrays.n_splats());
    let undone = model
        .queue_chunks(true, &edits)
        .unwrap()
        .unwrap()
        .finish()
        .unwrap();
    assert!(
        !undone.is_complete && !undone.chunks.is_empty(),
        "only changed chunks are sent after an edit"
    );

    let folder = tempfile::tempdir().unwrap();
    model.save(folder.path()).unwrap();
    edits.write(folder.path()).unwrap();
    assert_eq!(
        file::read(folder.path()).unwrap().n_splats(),
        arrays.n_splats(),
        "the folder holds the complete model"
    );
    let kind = ModelKind::of_saved(folder.path()).unwrap().unwrap();
    let out = folder.path().join("exported.ply");
    let export = kind
        .entry()
        .exports
        .iter()
        .find(|export| export.format == "ply")
        .unwrap();
    let ExportWriter::Cpu(write) = export.write else {
        panic!("no GPU is needed")
    };
    write(&ExportRequest {
        model: folder.path(),
        out: &out,
        cell_m: None,
    })
    .unwrap();
    assert_eq!(ply::read(&out).unwrap().means, left.means);
}

#[test]
fn floaters_are_found_and_the_rest_is_kept() {
    let arrays = scene_with_floaters();
    let mut model = model_of(&arrays);
    let floaters = find_floaters(&mut model, &Arc::default()).unwrap();
    assert_eq!((floaters.n_erased, floaters.item), (21, "splat"));
    let edits = edits_of([Edit::Cells(floaters.cells)]);
    assert_eq!(arrays.clone().without_erased(&edits).means, scene().means);
    let alone = picture(&mut model_of(&scene()), &Arc::default());
    assert!(
        !is_same(&picture(&mut model, &Arc::default()), &alone),
        "the floaters are in view"
    );
    assert!(is_same(&picture(&mut model, &edits), &alone));
    assert!(
        matches!(find_floaters(&mut model, &edits), Err(Error::NoFloaters)),
        "they are erased already"
    );
}

#[test]
fn background_far_away_is_not_a_floater() {
    // A few large splats at ten times the radius of the scene, as of a sky.
    const FACTOR: f32 = 10.0;
    let mut arrays = scene();
    for ix in (0..arrays.n_splats()).step_by(8) {
        arrays
            .means
            .push(arrays.means[ix].map(|along| FACTOR * along));
        arrays
            .log_scales
            .push(arrays.log_scales[ix].map(|log_scale| log_scale + (2.8 * FACTOR).ln()));
        arrays.rotations_wxyz.push(arrays.rotations_wxyz[ix]);
        arrays.opacity_logits.push(4.0);
        arrays.sh.extend_from_within(16 * ix..16 * (ix + 1));
    }
    let found = find_floaters(&mut model_of(&arrays), &Arc::default());
    let n_erased = found.map_or(0, |found| found.n_erased);
    assert_eq!(n_erased, 0);
}

/// Prints how long a search takes: `cargo test --release -- --ignored --nocapture
/// time_of_a_search`.
#[test]
#[ignore = "measures time"]
fn time_of_a_search() {
    for n_splats in [100_000, 1_000_000] {
        let arrays = model_files::splat::cloud::scan_cloud(n_splats, 3);
        let began = std::time::Instant::now();
        let found = super::floaters::floaters(&arrays);
        eprintln!(
            "{n_splats} splats: {:?}, {:?} erased",
            began.elapsed(),
            found.map(|found| found.n_erased)
        );
    }
}
