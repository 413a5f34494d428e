//! Tests of reading and writing `.ply` files.

use super::*;
use crate::splat::cloud::synthetic_cloud;

/// A cloud of five splats of this SH degree.
fn cloud_of_degree(sh_degree: u32) -> SplatArrays {
    let cloud = synthetic_cloud(5, 1);
    let n_kept = (sh_degree as usize + 1).pow(2);
    let sh = cloud.sh.chunks_exact(16).flat_map(|splat| splat[..n_kept].to_vec()).collect();
    SplatArrays { sh, sh_degree, ..cloud }
}

#[test]
fn every_degree_round_trips_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("splats.ply");
    for sh_degree in 0..=3 {
        let cloud = cloud_of_degree(sh_degree);
        write(&path, &cloud).unwrap();
        assert_eq!(read(&path).unwrap(), cloud);
    }
    write(&path, &SplatArrays::default()).unwrap();
    assert_eq!(read(&path).unwrap().n_splats(), 0);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no partial file remains");
}

#[test]
fn layout_matches_other_programs() {
    let mut file = Vec::new();
    let mut cloud = cloud_of_degree(1);
    cloud.sh[1] = [11.0, 12.0, 13.0];
    write_to(&mut file, &cloud).unwrap();
    let header = Header::parse(&file).unwrap();
    let table = header.table("vertex", &file).unwrap();
    let at = |name: &str| table.column(name).unwrap().f32(0);
    // All higher coefficients of red come first: three at degree 1.
    assert_eq!([at("f_rest_0"), at("f_rest_3"), at("f_rest_6")], [11.0, 12.0, 13.0]);
    assert_eq!([at("rot_0"), at("rot_3")], [cloud.rotations_wxyz[0][0], cloud.rotations_wxyz[0][3]]);
    assert!(file.starts_with(b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\n"));
}

#[test]
fn properties_are_read_in_any_order_and_type() {
    let mut file = b"ply\r\n".to_vec();
    assert!(from_bytes(&file).unwrap_err().contains("Unix line endings"));
    file.clear();
    let names = ["rot_3", "rot_2", "rot_1", "rot_0", "f_dc_2", "f_dc_1", "f_dc_0", "opacity", "scale_2", "scale_1"];
    file.extend_from_slice(b"ply\nformat binary_little_endian 1.0\ncomment any order\nelement vertex 1\n");
    for name in names.into_iter().chain(["scale_0", "z", "y", "x"]) {
        file.extend_from_slice(format!("property double {name}\n").as_bytes());
    }
    file.extend_from_slice(b"property uchar extra\nend_header\n");
    for value in 0..14 {
        file.extend_from_slice(&f64::from(value).to_le_bytes());
    }
    file.push(0);
    let splats = from_bytes(&file).unwrap();
    assert_eq!(splats.rotations_wxyz, [[3.0, 2.0, 1.0, 0.0]]);
    assert_eq!((splats.sh, splats.opacity_logits), (vec![[6.0, 5.0, 4.0]], vec![7.0]));
    assert_eq!((splats.log_scales, splats.means), (vec![[10.0, 9.0, 8.0]], vec![[13.0, 12.0, 11.0]]));
}

#[test]
fn broken_files_are_rejected_with_the_reason() {
    let mut file = Vec::new();
    write_to(&mut file, &cloud_of_degree(0)).unwrap();
    let error_of = |bytes: &[u8]| from_bytes(bytes).unwrap_err();
    assert!(error_of(&file[..file.len() - 1]).contains("truncated: fewer than 5 rows of \"vertex\""));
    assert!(error_of(b"solid").contains("no PLY header"));
    let text = String::from_utf8_lossy(&file).into_owned();
    assert!(error_of(text.replace("binary_little_endian", "ascii").as_bytes()).contains("format ascii"));
    assert!(error_of(text.replace("opacity", "opacitx").as_bytes()).contains("no property \"opacity\""));
    assert!(error_of(text.replace("vertex 5", "vertex 99999999999999999999").as_bytes()).contains("not a number"));
    assert!(error_of(text.replace("vertex 5", "vertex 9999999999999999999").as_bytes()).contains("truncated"));
    let folder = tempfile::tempdir().unwrap();
    let mut not_finite = cloud_of_degree(0);
    not_finite.means[2][0] = f32::NAN;
    let path = folder.path().join("nan.ply");
    write(&path, &not_finite).unwrap();
    assert_eq!(read(&path).unwrap_err().to_string(), "splats: mean of splat 2 is not finite");
    assert!(matches!(write(&folder.path().join("none/splats.ply"), &not_finite), Err(Error::Write { .. })));
}

#[test]
fn packed_files_of_another_program_are_read() {
    let Some(folder) = test_support::data_folder("splats") else { return };
    let small = read(&folder.join("test.ply")).unwrap();
    assert_eq!((small.n_splats(), small.sh_degree), (64, 3));
    // The bounds of the file's only chunk.
    let bounds = [-1.3947..=0.0, -0.8957..=0.0, 0.0..=0.5489];
    assert!(small.means.iter().all(|mean| (0..3).all(|axis| bounds[axis].contains(&mean[axis]))));
    let guitar = read(&folder.join("guitar.compressed.ply")).unwrap();
    assert_eq!(guitar.n_splats(), 90_854);
    let norms = guitar.rotations_wxyz.iter().map(|wxyz| wxyz.iter().map(|part| part * part).sum::<f32>());
    assert!(norms.into_iter().all(|norm| (norm - 1.0).abs() < 1e-5));
}

#[test]
fn packed_file_with_missing_colors_is_rejected() {
    let seed =
        |name: &str| std::fs::read(format!("{}/../fuzz/seeds/model/{name}", env!("CARGO_MANIFEST_DIR"))).unwrap();
    assert_eq!(from_bytes(&seed("ply-packed")[1..]).unwrap().n_splats(), 2);
    let error = from_bytes(&seed("ply-packed-colours-missing")[1..]).unwrap_err();
    assert_eq!(error, "element \"sh\" has 1 rows, expected 2");
}
