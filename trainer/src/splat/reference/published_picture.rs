//! Comparison with an independent renderer. The picture shows four splats that were rendered by
//! gsplat, and was published with Brush (Apache-2.0).

use super::{Splat, View, render};
use crate::mismatches::Mismatches;
use kinematics::Transform;
use nalgebra::Vector3;
use safetensors::SafeTensors;

/// The published picture was computed in f32. The largest difference is a quarter of these
/// tolerances. A different decision at a splat's edge (alpha 1/255) would cause a difference a
/// thousand times as large.
const ABS: f64 = 2e-6;
const REL: f64 = 1e-5;

/// The values of a tensor of f32.
fn floats(tensors: &SafeTensors<'_>, name: &str) -> Vec<f64> {
    let data = tensors
        .tensor(name)
        .expect("the file contains this tensor")
        .data();
    data.chunks_exact(4)
        .map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])))
        .collect()
}

#[test]
fn render_matches_a_published_picture() {
    let Some(folder) = test_support::data_folder("splats") else {
        return;
    };
    let bytes = std::fs::read(folder.join("brush_tiny_case.safetensors"))
        .expect("the test data contain this file");
    let tensors = SafeTensors::deserialize(&bytes).expect("a valid file");
    let &[height, width, 4] = tensors
        .tensor("out_img")
        .expect("the file contains the picture")
        .shape()
    else {
        panic!("the picture has four channels");
    };
    // The file has these conventions. `scales` are logarithms, and `opacities` are logits. `quats`
    // have w first. `coeffs` are as in 3DGS, with the constant first. The camera has a field of
    // view of 90 degrees, is at (0.123, 0.456, -8) and looks along z. The principal point is at the
    // center. Colors are clamped at 0 and premultiplied, without background. The fourth channel is
    // 1 - transmittance.
    let focal_px = 0.5 * width as f64;
    let view = View {
        camera_from_world: Transform::new(Vector3::new(-0.123, -0.456, 8.0), Vector3::zeros()),
        focal_px: [focal_px; 2],
        principal_px: [0.5 * width as f64, 0.5 * height as f64],
        size_px: [width, height].map(|side| u32::try_from(side).expect("a small picture")),
        near_m: 0.01,
        linear_m: [0.0; 3],
        angular_rad: [0.0; 3],
        is_antialiased: false,
    };
    let means = floats(&tensors, "means");
    let scales = floats(&tensors, "scales");
    let quats = floats(&tensors, "quats");
    let opacities = floats(&tensors, "opacities");
    let coeffs = floats(&tensors, "coeffs");
    let picture = floats(&tensors, "out_img");
    let splat = |ix: usize| Splat {
        mean: std::array::from_fn(|axis| means[3 * ix + axis]),
        log_scale: std::array::from_fn(|axis| scales[3 * ix + axis]),
        rotation_wxyz: std::array::from_fn(|part| quats[4 * ix + part]),
        opacity_logit: opacities[ix],
        sh: coeffs[48 * ix..48 * (ix + 1)].as_chunks().0.to_vec(),
    };
    let splats: Vec<_> = (0..opacities.len()).map(splat).collect();

    let image = render(&view, &splats);
    let mut mismatches = Mismatches::default();
    for (pixel_ix, expected) in picture.as_chunks::<4>().0.iter().enumerate() {
        let [r, g, b] = image.rgb[pixel_ix];
        for (channel, got) in [r, g, b, 1.0 - image.transmittance[pixel_ix]]
            .into_iter()
            .enumerate()
        {
            mismatches.check(
                format!("pixel {pixel_ix} channel {channel}"),
                got,
                expected[channel],
                ABS,
                REL,
            );
        }
    }
    assert!(
        picture.iter().filter(|value| **value > 0.1).count() > 1000,
        "the picture is not empty"
    );
    mismatches.assert_none();
}
