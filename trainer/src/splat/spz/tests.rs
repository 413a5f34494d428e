//! Tests of reading and writing `.spz` files.

use super::*;
use crate::spherical_harmonics as sh;
use crate::splat::cloud::synthetic_cloud;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

/// A cloud of `n_splats` splats of this SH degree.
fn cloud_of_degree(n_splats: usize, sh_degree: u32) -> SplatArrays {
    let cloud = synthetic_cloud(n_splats, 1);
    let n_kept = (sh_degree as usize + 1).pow(2);
    let sh = cloud.sh.chunks_exact(16).flat_map(|splat| splat[..n_kept].to_vec()).collect();
    SplatArrays { sh, sh_degree, ..cloud }
}

fn packed(uncompressed: &[u8]) -> Vec<u8> {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::default());
    gzip.write_all(uncompressed).unwrap();
    gzip.finish().unwrap()
}

fn quaternion(wxyz: [f32; 4]) -> UnitQuaternion<f64> {
    let [w, x, y, z] = wxyz.map(f64::from);
    UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
}

/// Checks that the largest difference of two lists is within a bound and exceeds half of it.
fn assert_max_difference(what: &str, got: &[f32], expected: &[f32], bound: f32) {
    assert_eq!(got.len(), expected.len(), "{what}");
    let worst = got.iter().zip(expected).map(|(got, expected)| (got - expected).abs()).fold(0.0, f32::max);
    assert!(worst <= bound * 1.0001, "{what}: largest difference {worst}, expected at most {bound}");
    assert!(worst > 0.5 * bound, "{what}: largest difference {worst}, the bound {bound} is too loose");
}

#[test]
fn every_value_round_trips_within_its_step() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.spz");
    for sh_degree in 0..=3 {
        let mut cloud = cloud_of_degree(3000, sh_degree);
        cloud.means[7] = [-100.0, 60.0, 0.0];
        write(&path, &cloud).unwrap();
        let decoded = read(&path).unwrap();
        assert_eq!(decoded.sh_degree, sh_degree);
        assert_max_difference("means", decoded.means.as_flattened(), cloud.means.as_flattened(), 0.5 / 65536.0);
        assert_max_difference(
            "log scales",
            decoded.log_scales.as_flattened(),
            cloud.log_scales.as_flattened(),
            0.5 / 16.0,
        );
        let opacity = |logits: &[f32]| logits.iter().map(|logit| 1.0 / (1.0 + (-logit).exp())).collect::<Vec<_>>();
        assert_max_difference(
            "opacities",
            &opacity(&decoded.opacity_logits),
            &opacity(&cloud.opacity_logits),
            0.5 / 255.0,
        );
        let rotation_pairs = decoded.rotations_wxyz.iter().zip(&cloud.rotations_wxyz);
        let worst_rad = rotation_pairs.map(|(a, b)| quaternion(*a).angle_to(&quaternion(*b))).fold(0.0, f64::max);
        assert!(worst_rad < 0.26_f64.to_radians(), "rotations: {} degrees", worst_rad.to_degrees());
        let coefficients = |cloud: &SplatArrays, functions: std::ops::Range<usize>| -> Vec<f32> {
            let of_splat = cloud.sh.chunks_exact(cloud.n_coefficients());
            of_splat.flat_map(|of| of[functions.clone()].as_flattened().to_vec()).collect()
        };
        assert_max_difference(
            "constant",
            &coefficients(&decoded, 0..1),
            &coefficients(&cloud, 0..1),
            0.5 / (255.0 * 0.15),
        );
        for degree in 1..=sh_degree {
            let functions = (degree * degree) as usize..((degree + 1) * (degree + 1)) as usize;
            let expected = coefficients(&cloud, functions.clone());
            assert_max_difference(
                &format!("degree {degree}"),
                &coefficients(&decoded, functions),
                &expected,
                0.5 / 128.0,
            );
        }
        // A second round trip can only change rotations whose two largest components are nearly equal.
        write(&path, &decoded).unwrap();
        let decoded_twice = read(&path).unwrap();
        assert!(
            decoded_twice.means == decoded.means
                && decoded_twice.log_scales == decoded.log_scales
                && decoded_twice.sh == decoded.sh
        );
        assert!(decoded_twice.opacity_logits == decoded.opacity_logits);
    }
    write(&path, &SplatArrays::default()).unwrap();
    assert_eq!(read(&path).unwrap().n_splats(), 0);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no partial file remains");
}

/// The expected bytes are computed by hand from the specification of the format.
#[test]
fn one_splat_file_has_the_specified_bytes() {
    let splat = SplatArrays {
        means: vec![[1.0, -2.0, 3.0]],
        log_scales: vec![[-10.0, -3.0, 5.9375]],
        // A rotation by 90 degrees about y. The quaternion is negated and not normalized.
        rotations_wxyz: vec![[-2.0, 0.0, -2.0, 0.0]],
        opacity_logits: vec![0.0],
        sh: vec![[0.0, 1.0, -9.0], [0.25, 0.5, -0.5], [0.0, 1.0, -1.0], [0.125, 0.0, 0.0]],
        sh_degree: 1,
        is_antialiased: false,
    };
    #[rustfmt::skip]
    let expected = [
        b'N', b'G', b'S', b'P', 3, 0, 0, 0, 1, 0, 0, 0, 1, 16, 0, 0, // One splat of degree 1, 16 fractional bits.
        0x00, 0x00, 0x01, 0x00, 0x00, 0x02, 0x00, 0x00, 0xfd,        // 1, 2 and -3 times 2^16: y and z change sign.
        128,                                                         // Half of 255, rounded up.
        128, 166, 0,                                                 // 127.5 + 38.25 * coefficient, clamped at 0.
        0, 112, 255,                                                 // 16 (log scale + 10)
        // (x, -y, -z, w) is (0, -1, 0, 1) / sqrt(2). y is the first of the two largest components and therefore
        // omitted; the other signs flip because y is negative.
        0xff, 0x03, 0x00, 0x40,                                      // Index 01; sign and magnitude: 0 0, 0 0, 1 511.
        96, 64, 192,                                                 // -y: 128 - 32, - 64, + 64
        128, 0, 255,                                                 // -z: 128, - 128, + 128 clamped at the upper end
        144, 128, 128,                                               // x: 128 + 16
    ];
    assert_eq!(uncompressed_bytes(&splat).unwrap(), expected);
    let decoded = from_bytes(&packed(&expected)).unwrap().0.checked().unwrap();
    assert_eq!((decoded.means[0], decoded.log_scales[0]), (splat.means[0], splat.log_scales[0]));
    assert!(quaternion(decoded.rotations_wxyz[0]).angle_to(&quaternion(splat.rotations_wxyz[0])) < 1e-3);
    assert_eq!(decoded.sh[1..], [[0.25, 0.5, -0.5], [0.0, 1.0, -0.992_187_5], [0.125, 0.0, 0.0]]);

    let mut older = expected.to_vec();
    older[4] = 2;
    older.splice(32..36, [128, 38, 128]); // x and z about 0, y: 127.5 (1 - 1/sqrt(2)).
    let decoded = from_bytes(&packed(&older)).unwrap().0.checked().unwrap();
    assert!(quaternion(decoded.rotations_wxyz[0]).angle_to(&quaternion(splat.rotations_wxyz[0])).to_degrees() < 1.5);
}

/// The color in a direction equals the color of the flipped splat in the flipped direction.
#[test]
fn colors_follow_the_axis_flip() {
    let coefficients: Vec<[f64; 3]> = synthetic_cloud(1, 5).sh.iter().map(|rgb| rgb.map(f64::from)).collect();
    let mut flipped_coefficients = coefficients.clone();
    for (rgb, sign) in flipped_coefficients[1..].iter_mut().zip(SH_SIGNS) {
        *rgb = rgb.map(|value| f64::from(sign) * value);
    }
    for offset in [Vector3::new(0.3, -0.5, 0.8), Vector3::new(-0.9, 0.2, 0.1), Vector3::new(0.1, 0.7, -0.6)] {
        let there = sh::color(&flipped_coefficients, &Vector3::new(offset.x, -offset.y, -offset.z));
        for (here, there) in sh::color(&coefficients, &offset).iter().zip(there) {
            assert!((here - there).abs() < 1e-12);
        }
    }
}

#[test]
fn broken_files_are_rejected_with_the_reason() {
    let uncompressed = uncompressed_bytes(&cloud_of_degree(5, 2)).unwrap();
    let whole = packed(&uncompressed);
    assert!(from_bytes(&whole).is_ok());
    let error_of = |bytes: &[u8]| from_bytes(bytes).unwrap_err();
    let error_with_byte = |at: usize, to: u8| {
        let mut uncompressed = uncompressed.clone();
        uncompressed[at] = to;
        error_of(&packed(&uncompressed))
    };
    assert_eq!(error_of(b"ply\n"), "not a gzip stream");
    assert_eq!(error_of(b""), "not a gzip stream");
    assert_eq!(error_of(b"NGSP\x04\0\0\0rest"), "format version 4, expected 2 or 3");
    assert!(error_of(&uncompressed).contains("gzip"));
    assert_eq!(error_with_byte(0, b'X'), "the decompressed data does not begin with \"NGSP\"");
    assert_eq!(error_with_byte(4, 1), "format version 1, expected 2 or 3");
    assert_eq!(error_with_byte(8, 6), "truncated: 6 splats need 264 bytes, found 220");
    assert_eq!(error_with_byte(8, 4), "44 bytes follow the last splat");
    assert!(error_with_byte(11, 255).contains("4278190085 splats, expected at most 100000000"));
    assert!(error_with_byte(11, 5).contains("specifies 83886085 splats, which a file of"));
    assert_eq!(error_with_byte(12, 4), "spherical harmonics of degree 4, expected at most 3");
    assert!(error_with_byte(12, 3).contains("truncated"));
    assert!(error_with_byte(13, 32).contains("32 fractional bits"));
    assert_eq!(error_of(&packed(&uncompressed[..7])), "truncated");
    for length in 2..whole.len() {
        assert!(error_of(&whole[..length]).contains("truncated"), "{length} of {} bytes", whole.len());
    }
    assert_eq!(error_of(&[&whole[..], b"tail"].concat()), "4 bytes follow the gzip stream");
    let mut damaged = whole.clone();
    let sum_at = damaged.len() - 8;
    damaged[sum_at] ^= 1;
    assert!(error_of(&damaged).starts_with("damaged ("));
    let mut extended = [&uncompressed[..], b"what other programs add"].concat();
    assert_eq!(error_of(&packed(&extended)), "23 bytes follow the last splat");
    extended[14] = HAS_EXTENSIONS;
    assert_eq!(from_bytes(&packed(&extended)).unwrap().1.len(), 1, "extensions are named");
}

#[test]
fn any_bytes_decode_to_finite_splats() {
    for version in [2, 3] {
        for value in [0, 1, 127, 128, 255] {
            let mut uncompressed = uncompressed_bytes(&cloud_of_degree(3, 3)).unwrap();
            uncompressed[HEADER_BYTES..].fill(value);
            uncompressed[4] = version;
            uncompressed.truncate(HEADER_BYTES + 3 * if version == 2 { 64 } else { 65 });
            from_bytes(&packed(&uncompressed)).unwrap().0.checked().unwrap();
        }
    }
}

#[test]
fn unsupported_values_are_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.spz");
    let mut cloud = cloud_of_degree(3, 0);
    cloud.means[1][2] = 9e6;
    assert!(write(&path, &cloud).unwrap_err().to_string().contains("a coordinate of 9000000 m"));
    cloud.means[1][2] = 8e6;
    write(&path, &cloud).unwrap();
    assert!((read(&path).unwrap().means[1][2] - 8e6).abs() < 1.0);
    cloud.means[1][2] = f32::NAN;
    assert_eq!(write(&path, &cloud).unwrap_err().to_string(), "splats: mean of splat 1 is not finite");
    cloud.means[1][2] = 0.0;
    assert!(matches!(write(&folder.path().join("none/scene.spz"), &cloud), Err(Error::Write { .. })));
}

#[test]
fn files_of_another_program_are_read() {
    let Some(folder) = test_support::data_folder("splats") else { return };
    for name in ["minimal-v2.spz", "minimal-v3.spz"] {
        let splats = read(&folder.join(name)).unwrap();
        assert_eq!((splats.n_splats(), splats.sh_degree), (4, 0), "{name}");
        assert!(splats.means.as_flattened().iter().all(|meters| [0.0, 1.0, -1.0].contains(meters)), "{name}");
        assert!(splats.log_scales.as_flattened().iter().all(|scale| (scale - 0.1_f32.ln()).abs() < 0.04), "{name}");
        assert!(splats.rotations_wxyz.iter().all(|wxyz| wxyz[0] > 0.999), "{name}: all are identity");
    }
    let newer = read(&folder.join("minimal-v4.spz")).unwrap_err().to_string();
    assert!(newer.ends_with("format version 4, expected 2 or 3"), "{newer}");
}
