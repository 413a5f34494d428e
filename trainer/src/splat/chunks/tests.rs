//! Tests of chunks, which are decoded as `docs/reference/protocol.md` says. The tests check the
//! errors of the values and of pictures, and which chunks count as changed.

use super::codec::{MAX_SH_DEGREE, encode};
use super::{COARSE_STRIDE, Chunker};
use crate::eval::{PixelPair, psnr};
use crate::splat::training_tests::{keyframes, options, request};
use crate::splat::{SplatOptions, SplatTrainer};
use crate::{
    ChunkData, ChunkLayout, Method, ModelChunk, ModelChunks, ModelOptions, Picture, Projection,
    RenderRequest,
};
use gpu::testing::test_gpu;
use model_files::splat::arrays::SplatArrays;
use model_files::splat::cloud::{scan_cloud, synthetic_cloud};
use nalgebra::{Quaternion, UnitQuaternion};
use std::collections::BTreeMap;
use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::Arc;

/// Splats of degree 2, like those that are read from the GPU for encoding.
fn of_degree_2(splats: SplatArrays) -> SplatArrays {
    let n = (MAX_SH_DEGREE as usize + 1).pow(2);
    let sh = splats
        .sh
        .chunks_exact(splats.n_coefficients())
        .flat_map(|of| of[..n].to_vec())
        .collect();
    SplatArrays {
        sh,
        sh_degree: MAX_SH_DEGREE,
        ..splats
    }
}

#[expect(clippy::cast_possible_truncation, reason = "splats are f32")]
fn decoded(data: &ChunkData) -> SplatArrays {
    let ChunkLayout::Splats {
        n_splats,
        min_m,
        max_m,
        log_scale_range,
        scale_factor,
        sh_degree,
        sh_ranges,
        ..
    } = data.layout
    else {
        panic!("splats")
    };
    let words: Vec<u32> = data
        .bytes
        .as_chunks::<4>()
        .0
        .iter()
        .map(|bytes| u32::from_le_bytes(*bytes))
        .collect();
    assert_eq!(words.len(), n_splats * if sh_degree > 0 { 8 } else { 4 });
    let (base, sh_words) = words.split_at(4 * n_splats);
    let mut splats = SplatArrays {
        sh_degree: MAX_SH_DEGREE,
        ..SplatArrays::default()
    };
    let scaled = |count: u32, max: u32, [low, high]: [f64; 2]| {
        low + f64::from(count) / f64::from(max) * (high - low)
    };
    for (ix, word) in base.as_chunks::<4>().0.iter().enumerate() {
        let counts = [
            word[0] & 8191,
            word[0] >> 13 & 8191,
            word[0] >> 26 | (word[1] & 127) << 6,
        ];
        splats.means.push(std::array::from_fn(|axis| {
            scaled(counts[axis], 8191, [min_m[axis].into(), max_m[axis].into()]) as f32
        }));
        splats.log_scales.push([7, 15, 23].map(|at| {
            let log_scale = scaled(word[1] >> at & 255, 255, log_scale_range.map(f64::from));
            (log_scale + f64::from(scale_factor).ln()) as f32
        }));
        let others = [20, 10, 0]
            .map(|at| scaled(word[2] >> at & 1023, 1023, [-FRAC_1_SQRT_2, FRAC_1_SQRT_2]));
        let largest = (1.0 - others.iter().map(|part| part * part).sum::<f64>())
            .max(0.0)
            .sqrt();
        let mut wxyz = others.to_vec();
        wxyz.insert((word[2] >> 30) as usize, largest);
        splats
            .rotations_wxyz
            .push(std::array::from_fn(|part| wxyz[part] as f32));
        let alpha = scaled(word[3] & 255, 255, [0.0, 1.0]).min(0.999);
        splats
            .opacity_logits
            .push((alpha / (1.0 - alpha)).ln() as f32);
        splats.sh.push([8, 16, 24].map(|at| {
            ((scaled(word[3] >> at & 255, 255, [-0.5, 1.5]) - 0.5) / super::codec::SH_0) as f32
        }));
        for function in 0..8 {
            let range = f64::from(sh_ranges[usize::from(function >= 3)]);
            splats.sh.push(std::array::from_fn(|channel| {
                let field = 3 * function + channel;
                let word = if sh_degree > 0 {
                    sh_words[4 * ix + field / 6]
                } else {
                    0
                };
                let count = if sh_degree > 0 {
                    word >> (5 * (field % 6)) & 31
                } else {
                    16
                };
                ((f64::from(count) - 16.0) / 15.0 * range) as f32
            }));
        }
    }
    splats.checked().unwrap()
}

/// The splats of several chunks.
fn joined<'a>(chunks: impl IntoIterator<Item = &'a ChunkData>) -> SplatArrays {
    let mut all = SplatArrays {
        sh_degree: MAX_SH_DEGREE,
        ..SplatArrays::default()
    };
    for splats in chunks.into_iter().map(decoded) {
        all.means.extend(splats.means);
        all.log_scales.extend(splats.log_scales);
        all.rotations_wxyz.extend(splats.rotations_wxyz);
        all.opacity_logits.extend(splats.opacity_logits);
        all.sh.extend(splats.sh);
    }
    all
}

fn coarse_or_fine(chunk: &ModelChunk) -> &ChunkData {
    chunk.coarse.as_ref().unwrap_or(&chunk.fine)
}

fn model(splats: &SplatArrays) -> SplatTrainer {
    let options = ModelOptions::from(SplatOptions {
        max_splats: 1_000_000,
        ..SplatOptions::default()
    });
    SplatTrainer::from_arrays(test_gpu(), options, splats).unwrap()
}

fn drawn(splats: &SplatArrays, request: &RenderRequest) -> Picture {
    model(splats).render(request).unwrap()
}

fn psnr_of(request: &RenderRequest, picture: &Picture, expected: &Picture) -> f64 {
    psnr(&PixelPair::new(request.size_px, &picture.rgba_srgb, &expected.rgba_srgb).unwrap())
        .unwrap()
}

fn worst(got: &[f32], expected: &[f32]) -> f64 {
    assert_eq!(got.len(), expected.len());
    got.iter()
        .zip(expected)
        .map(|(got, expected)| f64::from((got - expected).abs()))
        .fold(0.0, f64::max)
}

#[test]
fn values_are_rounded_within_their_steps() {
    let splats = of_degree_2(synthetic_cloud(2000, 5));
    let members: Vec<u32> = (0..2000).collect();
    let data = encode(&splats, &members, 1.0, 2);
    assert_eq!(data.bytes.len(), 32 * 2000);
    let got = decoded(&data);
    let ChunkLayout::Splats {
        log_scale_range: [low, high],
        sh_ranges,
        ..
    } = data.layout
    else {
        panic!("splats")
    };
    // A cube with an edge of 2 m.
    assert!(worst(got.means.as_flattened(), splats.means.as_flattened()) < 0.51 * 2.0 / 8191.0);
    let scale_step = f64::from(high - low) / 255.0;
    assert!(
        worst(
            got.log_scales.as_flattened(),
            splats.log_scales.as_flattened()
        ) < 0.51 * scale_step
    );
    let rotation = |wxyz: [f32; 4]| {
        let [w, x, y, z] = wxyz.map(f64::from);
        UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
    };
    let angles = got
        .rotations_wxyz
        .iter()
        .zip(&splats.rotations_wxyz)
        .map(|(a, b)| rotation(*a).angle_to(&rotation(*b)));
    let worst_rad = angles.fold(0.0, f64::max);
    assert!(worst_rad < 0.004, "{worst_rad} rad");
    for ix in &members {
        assert!(
            (got.opacity(*ix as usize) - splats.opacity(*ix as usize)).abs() < 0.51 / 255.0 + 1e-3
        );
    }
    let coefficients = |splats: &SplatArrays, functions: std::ops::Range<usize>| -> Vec<f32> {
        splats
            .sh
            .chunks_exact(9)
            .flat_map(|of| of[functions.clone()].as_flattened().to_vec())
            .collect()
    };
    let constants = [coefficients(&got, 0..1), coefficients(&splats, 0..1)];
    let is_in_range = |value: &f32| (0.282 * value).abs() < 0.99;
    let [got_constants, constants] = [&constants[0], &constants[1]].map(|values| {
        values
            .iter()
            .zip(&constants[1])
            .filter(|(_, exact)| is_in_range(exact))
            .map(|(value, _)| *value)
            .collect::<Vec<_>>()
    });
    assert!(worst(&got_constants, &constants) < 0.51 * 2.0 / 255.0 / 0.282);
    for (functions, range) in [(1..4, sh_ranges[0]), (4..9, sh_ranges[1])] {
        let (got, exact) = (
            coefficients(&got, functions.clone()),
            coefficients(&splats, functions),
        );
        let clamped: Vec<f32> = exact
            .iter()
            .map(|value| value.clamp(-range, range))
            .collect();
        assert!(
            worst(&got, &clamped) < 0.51 * f64::from(range) / 15.0,
            "range {range}"
        );
        // Four standard deviations of 0.2.
        assert!((0.5..=0.81).contains(&range), "{range}");
    }
}

/// The view of a scan: a wall of splats at a distance of 3.2 m.
fn scan_request() -> RenderRequest {
    RenderRequest {
        world_from_camera: kinematics::Transform::translation(0.0, 0.0, -3.2),
        size_px: [320, 240],
        projection: Projection::Pinhole {
            focal_px: [288.0; 2],
            principal_px: [160.0, 120.0],
        },
        ..request(kinematics::Transform::identity())
    }
}

#[test]
fn pictures_of_decoded_chunks_are_accurate() {
    let splats = of_degree_2(scan_cloud(30_000, 1));
    let chunks = Chunker::default().chunks(&splats, true);
    assert!(chunks.is_complete && chunks.chunks.len() > 10);
    let request = scan_request();
    let expected = drawn(&splats, &request);
    let fine = joined(chunks.chunks.iter().map(|chunk| &chunk.fine));
    let coarse = joined(chunks.chunks.iter().map(coarse_or_fine));
    assert!(
        COARSE_STRIDE * coarse.n_splats() < fine.n_splats() + COARSE_STRIDE * chunks.chunks.len()
    );
    let fine_db = psnr_of(&request, &drawn(&fine, &request), &expected);
    let coarse_db = psnr_of(&request, &drawn(&coarse, &request), &expected);
    eprintln!("fine {fine_db:.1} dB, coarse {coarse_db:.1} dB");
    assert!(fine_db > 36.0, "{fine_db} dB");
    assert!(coarse_db > 14.0, "{coarse_db} dB");
}

#[test]
fn pictures_of_a_trained_model_are_accurate() {
    let gpu = test_gpu();
    let mut trainer = SplatTrainer::new(gpu.clone(), options()).unwrap();
    let keyframes = keyframes(&gpu, true);
    for keyframe in &keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    assert!(
        trainer
            .queue_chunks(true, &Arc::default())
            .unwrap()
            .is_none(),
        "no splats yet"
    );
    while trainer.progress().step < 100 {
        trainer.step(20).unwrap();
    }
    let pending = trainer
        .queue_chunks(true, &Arc::default())
        .unwrap()
        .unwrap();
    let request = request(keyframes[3].world_from_camera);
    let expected = trainer.render(&request).unwrap();
    // Later training does not affect the result.
    while trainer.progress().step < 120 {
        trainer.step(20).unwrap();
    }
    let chunks = pending.finish().unwrap();
    let db = psnr_of(
        &request,
        &drawn(
            &joined(chunks.chunks.iter().map(|chunk| &chunk.fine)),
            &request,
        ),
        &expected,
    );
    assert!(db > 36.0, "{db} dB");
    let later = trainer
        .queue_chunks(true, &Arc::default())
        .unwrap()
        .unwrap()
        .finish()
        .unwrap();
    assert!(
        !later.is_complete && !later.chunks.is_empty(),
        "training changes splats"
    );
    assert!(
        trainer
            .queue_chunks(true, &Arc::default())
            .unwrap()
            .unwrap()
            .finish()
            .unwrap()
            .chunks
            .is_empty(),
        "nothing has changed"
    );
    assert!(
        trainer
            .queue_chunks(false, &Arc::default())
            .unwrap()
            .unwrap()
            .finish()
            .unwrap()
            .is_complete
    );
}

#[test]
fn changes_are_listed_where_they_are_and_by_their_size() {
    let mut splats = of_degree_2(synthetic_cloud(12_000, 2));
    let mut chunker = Chunker::default();
    let mut known: BTreeMap<u64, usize> = BTreeMap::new();
    let mut apply = |new: &ModelChunks| {
        for id in &new.removed {
            assert!(known.remove(id).is_some(), "an unknown chunk is removed");
        }
        for chunk in &new.chunks {
            let ChunkLayout::Splats { n_splats, .. } = chunk.fine.layout else {
                panic!("splats")
            };
            known.insert(chunk.id, n_splats);
        }
        known.values().sum::<usize>()
    };
    let n_visible = |splats: &SplatArrays| splats.visible().len();
    let first = chunker.chunks(&splats, true);
    assert_eq!(apply(&first), n_visible(&splats));
    assert!(chunker.chunks(&splats, true).chunks.is_empty());
    // There are two splats far from each other. The color of the first splat changes much more.
    let corner = |sign: f32| {
        (0..splats.n_splats())
            .max_by(|a, b| {
                let along = |ix: usize| sign * splats.means[ix].iter().sum::<f32>();
                along(*a).total_cmp(&along(*b))
            })
            .unwrap()
    };
    let [a, b] = [corner(1.0), corner(-1.0)];
    for ix in [a, b] {
        splats.opacity_logits[ix] = 3.0;
        splats.log_scales[ix] = [-1.5; 3];
    }
    chunker.chunks(&splats, true);
    for (ix, change) in [(a, 0.5), (b, 0.1)] {
        splats.sh[9 * ix][0] += change;
    }
    let changed = chunker.chunks(&splats, true);
    assert!(
        changed.removed.is_empty() && changed.chunks.len() == 2,
        "{} chunks",
        changed.chunks.len()
    );
    let mut changes: Vec<f64> = changed.chunks.iter().map(|chunk| chunk.change).collect();
    changes.sort_by(f64::total_cmp);
    assert!(changes[1] > 2.0 * changes[0], "{changes:?}");
    // When the model grows, cells are divided. No splat is lost or doubled.
    let more = of_degree_2(synthetic_cloud(20_000, 3));
    splats.means.extend(more.means);
    splats.log_scales.extend(more.log_scales);
    splats.rotations_wxyz.extend(more.rotations_wxyz);
    splats.opacity_logits.extend(more.opacity_logits);
    splats.sh.extend(more.sh);
    splats.means[17] = [f32::NAN; 3];
    let grown = chunker.chunks(&splats, true);
    assert!(!grown.removed.is_empty());
    assert_eq!(apply(&grown), n_visible(&splats));
    assert!(
        n_visible(&splats) < splats.n_splats(),
        "transparent splats and NaN are left out"
    );
}

/// The bytes of a chunk are relative to its box.
#[test]
fn chunk_whose_splats_move_together_has_changed() {
    let mut splats = of_degree_2(synthetic_cloud(300, 2));
    let mut chunker = Chunker::default();
    let first = chunker.chunks(&splats, true);
    for mean in &mut splats.means {
        mean[0] += 1e-3;
    }
    let moved = chunker.chunks(&splats, true);
    assert!(moved.removed.is_empty() && moved.chunks.len() == first.chunks.len());
}
