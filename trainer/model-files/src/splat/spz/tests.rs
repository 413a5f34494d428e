//! Tests of reading and writing `.spz` files.

use super::container::{HAS_EXTENSIONS, HEADER_BYTES, LONG_HEADER_BYTES};
use super::*;
use crate::splat::cloud::synthetic_cloud;
use nalgebra::{Quaternion, UnitQuaternion};
use ruzstd::encoding::{CompressionLevel, compress_to_vec};

/// A cloud of `n_splats` splats of this SH degree.
fn cloud_of_degree(n_splats: usize, sh_degree: u32) -> SplatArrays {
    let cloud = synthetic_cloud(n_splats, 1);
    let n_kept = (sh_degree as usize + 1).pow(2);
    let sh = cloud
        .sh
        .chunks_exact(16)
        .flat_map(|splat| splat[..n_kept].to_vec())
        .collect();
    SplatArrays {
        sh,
        sh_degree,
        ..cloud
    }
}

fn packed(uncompressed: &[u8]) -> Vec<u8> {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::default());
    gzip.write_all(uncompressed).unwrap();
    gzip.finish().unwrap()
}

/// Converts an uncompressed file of version 3 with less than 256 splats to version 4.
fn zstd_file(uncompressed: &[u8], extensions: &[u8]) -> Vec<u8> {
    let n_splats = usize::from(uncompressed[8]);
    let n_higher = (usize::from(uncompressed[12]) + 1).pow(2) - 1;
    let (mut table, mut streams) = (Vec::new(), Vec::new());
    let mut rest = &uncompressed[HEADER_BYTES..];
    for bytes_per_splat in [9, 1, 3, 3, 4, 3 * n_higher] {
        let (attribute, after) = rest.split_at(n_splats * bytes_per_splat);
        rest = after;
        if !attribute.is_empty() {
            let stream = compress_to_vec(attribute, CompressionLevel::Fastest);
            table.extend(
                [stream.len(), attribute.len()]
                    .map(|n_bytes| (n_bytes as u64).to_le_bytes())
                    .concat(),
            );
            streams.extend(stream);
        }
    }
    let table_start = u32::try_from(LONG_HEADER_BYTES + extensions.len()).unwrap();
    let mut header = uncompressed[..HEADER_BYTES].to_vec();
    (header[4], header[15]) = (4, u8::try_from(table.len() / 16).unwrap());
    [
        &header[..],
        &table_start.to_le_bytes(),
        &[0; 12],
        extensions,
        &table,
        &streams,
    ]
    .concat()
}

fn quaternion(wxyz: [f32; 4]) -> UnitQuaternion<f64> {
    let [w, x, y, z] = wxyz.map(f64::from);
    UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
}

/// Checks that the largest difference of two lists is within a bound and exceeds half of it.
fn assert_max_difference(what: &str, got: &[f32], expected: &[f32], bound: f32) {
    assert_eq!(got.len(), expected.len(), "{what}");
    let worst = got
        .iter()
        .zip(expected)
        .map(|(got, expected)| (got - expected).abs())
        .fold(0.0, f32::max);
    assert!(
        worst <= bound * 1.0001,
        "{what}: largest difference {worst}, expected at most {bound}"
    );
    assert!(
        worst > 0.5 * bound,
        "{what}: largest difference {worst}, the bound {bound} is too loose"
    );
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
        assert_max_difference(
            "means",
            decoded.means.as_flattened(),
            cloud.means.as_flattened(),
            0.5 / 65536.0,
        );
        assert_max_difference(
            "log scales",
            decoded.log_scales.as_flattened(),
            cloud.log_scales.as_flattened(),
            0.5 / 16.0,
        );
        let opacity = |logits: &[f32]| {
            logits
                .iter()
                .map(|logit| 1.0 / (1.0 + (-logit).exp()))
                .collect::<Vec<_>>()
        };
        assert_max_difference(
            "opacities",
            &opacity(&decoded.opacity_logits),
            &opacity(&cloud.opacity_logits),
            0.5 / 255.0,
        );
        let rotation_pairs = decoded.rotations_wxyz.iter().zip(&cloud.rotations_wxyz);
        let worst_rad = rotation_pairs
            .map(|(a, b)| quaternion(*a).angle_to(&quaternion(*b)))
            .fold(0.0, f64::max);
        assert!(
            worst_rad < 0.26_f64.to_radians(),
            "rotations: {} degrees",
            worst_rad.to_degrees()
        );
        let coefficients = |cloud: &SplatArrays, functions: std::ops::Range<usize>| -> Vec<f32> {
            let of_splat = cloud.sh.chunks_exact(cloud.n_coefficients());
            of_splat
                .flat_map(|of| of[functions.clone()].as_flattened().to_vec())
                .collect()
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
        // A second round trip can only change rotations whose two largest components are nearly
        // equal.
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
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        1,
        "no partial file remains"
    );
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
        sh: vec![
            [0.0, 1.0, -9.0],
            [0.25, 0.5, -0.5],
            [0.0, 1.0, -1.0],
            [0.125, 0.0, 0.0],
        ],
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
        // (x, -y, -z, w) is (0, -1, 0, 1) / sqrt(2). The component y is the first of the two
        // largest components and is therefore omitted. The other signs flip because y is negative.
        0xff, 0x03, 0x00, 0x40,                                      // Index 01; sign and magnitude: 0 0, 0 0, 1 511.
        96, 64, 192,                                                 // -y: 128 - 32, - 64, + 64
        128, 0, 255,                                                 // -z: 128, - 128, + 128 clamped at the upper end
        144, 128, 128,                                               // x: 128 + 16
    ];
    assert_eq!(uncompressed_bytes(&splat).unwrap(), expected);
    let decoded = from_bytes(&packed(&expected)).unwrap().0.checked().unwrap();
    assert_eq!(
        (decoded.means[0], decoded.log_scales[0]),
        (splat.means[0], splat.log_scales[0])
    );
    assert!(
        quaternion(decoded.rotations_wxyz[0]).angle_to(&quaternion(splat.rotations_wxyz[0])) < 1e-3
    );
    assert_eq!(
        decoded.sh[1..],
        [
            [0.25, 0.5, -0.5],
            [0.0, 1.0, -0.992_187_5],
            [0.125, 0.0, 0.0]
        ]
    );

    let mut older = expected.to_vec();
    older[4] = 2;
    older.splice(32..36, [128, 38, 128]); // x and z about 0, y: 127.5 (1 - 1/sqrt(2)).
    let decoded = from_bytes(&packed(&older)).unwrap().0.checked().unwrap();
    assert!(
        quaternion(decoded.rotations_wxyz[0])
            .angle_to(&quaternion(splat.rotations_wxyz[0]))
            .to_degrees()
            < 1.5
    );
}

#[test]
fn every_container_gives_the_same_splats() {
    for (n_splats, sh_degree) in [(5, 2), (3, 0), (0, 0)] {
        let uncompressed = uncompressed_bytes(&cloud_of_degree(n_splats, sh_degree)).unwrap();
        let expected = from_bytes(&packed(&uncompressed)).unwrap();
        assert_eq!((expected.0.n_splats(), expected.1.len()), (n_splats, 0));
        assert_eq!(
            from_bytes(&uncompressed).unwrap(),
            expected,
            "not compressed"
        );
        assert_eq!(
            from_bytes(&zstd_file(&uncompressed, &[])).unwrap(),
            expected,
            "version 4"
        );
    }
}

#[test]
fn axes_of_an_extension_apply() {
    // The record has a type, a size, and the number of the axes right, down, front, which are the
    // axes of a `.ply`.
    let axes = [0x03, 0x00, 0xbe, 0xad, 4, 0, 0, 0, 6, 0, 0, 0];
    let mut uncompressed = uncompressed_bytes(&cloud_of_degree(5, 1)).unwrap();
    let plain = from_bytes(&packed(&uncompressed)).unwrap().0;
    let file_with_unused_extension = zstd_file(&uncompressed, &axes);
    let note = "12 bytes of extensions are not used".to_owned();
    assert_eq!(
        from_bytes(&file_with_unused_extension).unwrap(),
        (plain.clone(), vec![note]),
        "the flag is not set"
    );
    uncompressed[14] = HAS_EXTENSIONS;
    let extended = [&uncompressed[..], &axes].concat();
    for (what, file) in [
        ("gzip", packed(&extended)),
        ("not compressed", extended.clone()),
        ("version 4", zstd_file(&uncompressed, &axes)),
    ] {
        let (splats, notes) = from_bytes(&file).unwrap();
        assert!(notes.is_empty(), "{what}: {notes:?}");
        for (ix, [x, y, z]) in plain.means.iter().enumerate() {
            assert_eq!(splats.means[ix], [*x, -y, -z], "{what}");
            let [w, x, y, z] = plain.rotations_wxyz[ix];
            assert_eq!(splats.rotations_wxyz[ix], [w, x, -y, -z], "{what}");
            let [constant, by_y, by_z, by_x] = plain.sh.as_chunks::<4>().0[ix];
            let negated = |rgb: [f32; 3]| rgb.map(|value| -value);
            assert_eq!(
                splats.sh[4 * ix..][..4],
                [constant, negated(by_y), negated(by_z), by_x],
                "{what}"
            );
        }
    }
}

#[test]
fn coefficients_of_degree_4_are_left_out() {
    let degree_3 = uncompressed_bytes(&cloud_of_degree(2, 3)).unwrap();
    let expected = from_bytes(&packed(&degree_3)).unwrap().0;
    let (rest, coefficients) = degree_3.split_at(degree_3.len() - 2 * 45);
    let mut degree_4 = rest.to_vec();
    degree_4[12] = 4;
    for of_splat in coefficients.chunks_exact(45) {
        degree_4.extend([of_splat, &[200; 27]].concat());
    }
    let note = "its color coefficients above degree 3 are not used".to_owned();
    assert_eq!(
        from_bytes(&packed(&degree_4)).unwrap(),
        (expected, vec![note])
    );
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
    assert_eq!(
        error_of(b"ply\n"),
        "it begins neither with a gzip stream nor with \"NGSP\""
    );
    assert_eq!(
        error_of(b""),
        "it begins neither with a gzip stream nor with \"NGSP\""
    );
    assert_eq!(
        error_of(b"NGSP\x05\0\0\0and so on"),
        "format version 5, expected 2 to 4"
    );
    assert_eq!(
        error_with_byte(0, b'X'),
        "the decompressed data does not begin with \"NGSP\""
    );
    assert_eq!(error_with_byte(4, 1), "format version 1, expected 2 to 4");
    assert_eq!(
        error_with_byte(4, 4),
        "a gzip stream of format version 4, which has no gzip stream"
    );
    assert_eq!(
        error_with_byte(8, 6),
        "truncated: 6 splats need 264 bytes, found 220"
    );
    assert_eq!(error_with_byte(8, 4), "44 bytes follow the last splat");
    assert!(error_with_byte(11, 255).contains("4278190085 splats, expected at most 100000000"));
    assert!(error_with_byte(11, 5).contains("specifies 83886085 splats, which a file of"));
    assert_eq!(
        error_with_byte(12, 5),
        "spherical harmonics of degree 5, expected at most 4"
    );
    assert!(error_with_byte(12, 3).contains("truncated"));
    assert!(error_with_byte(13, 32).contains("32 fractional bits"));
    assert_eq!(error_of(&packed(&uncompressed[..7])), "truncated");
    for length in 2..whole.len() {
        assert!(
            error_of(&whole[..length]).contains("truncated"),
            "{length} of {} bytes",
            whole.len()
        );
    }
    assert_eq!(
        error_of(&[&whole[..], b"tail"].concat()),
        "4 bytes follow the gzip stream"
    );
    let mut damaged = whole.clone();
    let sum_at = damaged.len() - 8;
    damaged[sum_at] ^= 1;
    assert!(error_of(&damaged).starts_with("damaged ("));
    let mut extended = [&uncompressed[..], b"what other programs add"].concat();
    assert_eq!(
        error_of(&packed(&extended)),
        "23 bytes follow the last splat"
    );
    extended[14] = HAS_EXTENSIONS;
    assert_eq!(
        from_bytes(&packed(&extended)).unwrap().1.len(),
        1,
        "extensions are named"
    );
}

#[test]
fn broken_uncompressed_files_are_rejected_with_the_reason() {
    let whole = uncompressed_bytes(&cloud_of_degree(5, 2)).unwrap();
    let error_of = |bytes: &[u8]| from_bytes(bytes).unwrap_err();
    for length in 4..whole.len() {
        assert!(
            error_of(&whole[..length]).starts_with("truncated"),
            "{length} of {} bytes",
            whole.len()
        );
    }
    assert_eq!(
        error_of(&whole[..whole.len() - 1]),
        "truncated: 5 splats need 220 bytes, found 219"
    );
    assert_eq!(
        error_of(&[&whole[..], b"tail"].concat()),
        "4 bytes follow the last splat"
    );
}

#[test]
fn broken_files_of_version_4_are_rejected_with_the_reason() {
    let whole = zstd_file(&uncompressed_bytes(&cloud_of_degree(5, 2)).unwrap(), &[]);
    let error_of = |bytes: &[u8]| from_bytes(bytes).unwrap_err();
    let error_with_byte = |at: usize, to: u8| {
        let mut damaged = whole.clone();
        damaged[at] = to;
        error_of(&damaged)
    };
    for length in 4..whole.len() {
        assert_eq!(
            error_of(&whole[..length]),
            "truncated",
            "{length} of {} bytes",
            whole.len()
        );
    }
    let n_bytes = whole.len();
    assert_eq!(
        error_with_byte(8, 4),
        "stream 0 has 45 uncompressed bytes, expected 36"
    );
    assert!(error_with_byte(11, 5).contains("specifies 83886085 splats, which a file of"));
    assert_eq!(
        error_with_byte(12, 3),
        "stream 5 has 120 uncompressed bytes, expected 225"
    );
    assert_eq!(error_with_byte(15, 5), "5 streams, expected 6");
    assert_eq!(
        error_with_byte(16, 31),
        format!("the table of streams begins at byte 31, expected 32 to {n_bytes}")
    );
    assert!(error_with_byte(19, 255).starts_with("the table of streams begins at byte 4278190112"));
    assert_eq!(
        error_with_byte(39, 255),
        "truncated",
        "stream 0 is longer than the file"
    );
    let first_stream = LONG_HEADER_BYTES + 6 * 16;
    assert!(error_with_byte(first_stream, 0).starts_with("stream 0 is damaged ("));
    assert_eq!(
        error_of(&[&whole[..], b"tail"].concat()),
        "4 bytes follow the last stream"
    );
}

#[test]
fn any_bytes_decode_to_finite_splats() {
    for version in [2, 3] {
        for value in [0, 1, 127, 128, 255] {
            let mut uncompressed = uncompressed_bytes(&cloud_of_degree(3, 3)).unwrap();
            uncompressed[HEADER_BYTES..].fill(value);
            uncompressed[4] = version;
            uncompressed.truncate(HEADER_BYTES + 3 * if version == 2 { 64 } else { 65 });
            from_bytes(&packed(&uncompressed))
                .unwrap()
                .0
                .checked()
                .unwrap();
        }
    }
}

#[test]
fn unsupported_values_are_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.spz");
    let mut cloud = cloud_of_degree(3, 0);
    cloud.means[1][2] = 9e6;
    assert!(
        write(&path, &cloud)
            .unwrap_err()
            .to_string()
            .contains("a coordinate of 9000000 m")
    );
    cloud.means[1][2] = 8e6;
    write(&path, &cloud).unwrap();
    assert!((read(&path).unwrap().means[1][2] - 8e6).abs() < 1.0);
    cloud.means[1][2] = f32::NAN;
    assert_eq!(
        write(&path, &cloud).unwrap_err().to_string(),
        "splats: mean of splat 1 is not finite"
    );
    cloud.means[1][2] = 0.0;
    assert!(matches!(
        write(&folder.path().join("none/scene.spz"), &cloud),
        Err(Error::Write { .. })
    ));
}

#[test]
fn files_of_another_program_are_read() {
    let Some(folder) = test_support::data_folder("splats") else {
        return;
    };
    for name in [
        "minimal-v2.spz",
        "minimal-raw.spz",
        "minimal-v3.spz",
        "minimal-v4.spz",
    ] {
        let splats = read(&folder.join(name)).unwrap();
        assert_eq!((splats.n_splats(), splats.sh_degree), (4, 0), "{name}");
        assert!(
            splats
                .means
                .as_flattened()
                .iter()
                .all(|meters| [0.0, 1.0, -1.0].contains(meters)),
            "{name}"
        );
        assert!(
            splats
                .log_scales
                .as_flattened()
                .iter()
                .all(|scale| (scale - 0.1_f32.ln()).abs() < 0.04),
            "{name}"
        );
        assert!(
            splats.rotations_wxyz.iter().all(|wxyz| wxyz[0] > 0.999),
            "{name}: all are identity"
        );
    }
}
