//! Tests of erased splats, which pictures, chunks and exports leave out, and of floaters.

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

/// The scene with smaller discs, so that the boxes contain some of them as a whole.
fn scene_of_small_discs() -> SplatArrays {
    let mut arrays = scene();
    arrays.log_scales.fill([-1.2, -1.2, -4.0]);
    arrays
}

fn n_uncovered(picture: &Picture) -> usize {
    let pixels = picture.rgba_srgb.chunks_exact(4);
    pixels.filter(|pixel| pixel[3] < 64).count()
}

/// The pixels of a picture that differ from the background.
fn covered(picture: &Picture) -> Vec<bool> {
    picture
        .rgba_srgb
        .chunks_exact(4)
        .map(|pixel| pixel[3] > 0)
        .collect()
}

#[test]
fn pictures_lack_erased_space_until_the_edit_is_undone() {
    let arrays = scene_of_small_discs();
    let mut model = model_of(&arrays);
    let whole = picture(&mut model, &Arc::default());
    let one = edits_of([erased_box([1.0, 0.0, 5.5])]);
    let two = edits_of([erased_box([1.0, 0.0, 5.5]), erased_box([-2.0, 0.5, 5.0])]);
    let mut n_before = n_uncovered(&whole);
    for edits in [&one, &two] {
        // Splats that no box cuts are drawn as in a model that has only these splats.
        let left = arrays.clone().without_hidden(edits);
        assert!(
            left.n_splats() < arrays.n_splats() && left.n_splats() > 300,
            "{} splats",
            left.n_splats()
        );
        let erased = picture(&mut model, edits);
        assert!(is_same(&erased, &picture(&mut model_of(&left), edits)));
        let n_after = n_uncovered(&erased);
        assert!(
            n_after > n_before + 50,
            "{n_after} pixels show the background, {n_before} before"
        );
        n_before = n_after;
    }
    assert!(
        is_same(&picture(&mut model, &Arc::default()), &whole),
        "after an undo"
    );
}

/// A needle along x with its center inside a box that is much shorter.
fn needle_and_box() -> (SplatArrays, Aabb) {
    let mut arrays = scene().filtered(|ix| ix == 0);
    arrays.means = vec![[0.0, 0.0, 5.0]];
    arrays.rotations_wxyz = vec![[1.0, 0.0, 0.0, 0.0]];
    arrays.log_scales = vec![[-0.5, -3.0, -3.0]];
    let aabb = Aabb {
        world_from_box: Transform::translation(0.0, 0.0, 5.0),
        min_m: [-0.4, -1.0, -1.0],
        max_m: [0.4, 1.0, 1.0],
    };
    (arrays, aabb)
}

#[test]
fn boxes_cut_splats_where_they_leave_them() {
    let (arrays, aabb) = needle_and_box();
    let mut model = model_of(&arrays);
    let mut request = request(Transform::identity());
    let whole = model.render(&request).unwrap();
    request.crop = Some(aabb);
    let cropped = model.render(&request).unwrap();
    request.crop = None;
    request.edits = edits_of([Edit::Box(aabb)]);
    let erased = model.render(&request).unwrap();
    // Every pixel belongs to one of the two parts.
    let mut n_of_parts = [0; 2];
    let pixels = |picture: &Picture| {
        let bytes = picture.rgba_srgb.chunks_exact(4).map(<[u8]>::to_vec);
        bytes.collect::<Vec<_>>()
    };
    let of_parts = covered(&cropped).into_iter().zip(covered(&erased));
    for (ix, (pixel, (is_cropped, is_erased))) in pixels(&whole).iter().zip(of_parts).enumerate() {
        if pixel[3] == 0 {
            assert!(!is_cropped && !is_erased, "pixel {ix}");
            continue;
        }
        assert!(is_cropped != is_erased, "pixel {ix}");
        n_of_parts[usize::from(is_erased)] += 1;
        let part = if is_cropped { &cropped } else { &erased };
        // Two kernels may round differently.
        let of_part = &pixels(part)[ix];
        let differences = of_part.iter().zip(pixel).map(|(a, b)| a.abs_diff(*b));
        assert!(differences.max() <= Some(1), "pixel {ix}");
    }
    // On each side, the needle is about 3.3 standard deviations of 0.6 m long, and the box is 0.4 m
    // long.
    let [n_inside, n_outside] = n_of_parts;
    assert!(
        n_inside > 10 && n_outside > n_inside,
        "{n_inside} pixels inside, {n_outside} outside"
    );
    assert_eq!(
        arrays.without_hidden(&request.edits).n_splats(),
        1,
        "a part of the splat remains"
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
fn chunks_lack_hidden_splats_and_exports_lack_erased_ones() {
    let arrays = scene_of_small_discs();
    let edits = edits_of([erased_box([1.0, 0.0, 5.5])]);
    let left = arrays.clone().without_erased(&edits);
    let shown = arrays.clone().without_hidden(&edits);
    assert!(left.n_splats() < shown.n_splats() && shown.n_splats() < arrays.n_splats());
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
    assert_eq!(n_in_chunks(&edits), shown.n_splats());
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
    // A few large splats are at ten times the radius of the scene, like the splats of a sky.
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
