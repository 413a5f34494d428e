//! Tests of reading and writing `.ply` files.

use super::*;
use crate::splat::cloud::synthetic_cloud;

/// A cloud of five splats of this SH degree.
fn cloud_of_degree(sh_degree: u32) -> SplatArrays {
    let cloud = synthetic_cloud(5, 1);
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
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        1,
        "no partial file remains"
    );
}

#[test]
fn layout_matches_other_programs() {
    let mut file = Vec::new();
    let mut cloud = cloud_of_degree(1);
    cloud.sh[1] = [11.0, 12.0, 13.0];
    write_to(&mut file, &cloud).unwrap();
    let header = Header::parse(&file).unwrap();
    let table = header.table("vertex").unwrap();
    let at = |name: &str| table.column(name).unwrap().f32(0);
    // All higher coefficients of red come first: three at degree 1.
    assert_eq!(
        [at("f_rest_0"), at("f_rest_3"), at("f_rest_6")],
        [11.0, 12.0, 13.0]
    );
    assert_eq!(
        [at("rot_0"), at("rot_3")],
        [cloud.rotations_wxyz[0][0], cloud.rotations_wxyz[0][3]]
    );
    assert!(file.starts_with(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\n"
    ));
}

#[test]
fn properties_are_read_in_any_order_and_type() {
    let mut file = Vec::new();
    let names = [
        "rot_3", "rot_2", "rot_1", "rot_0", "f_dc_2", "f_dc_1", "f_dc_0", "opacity", "scale_2",
        "scale_1",
    ];
    file.extend_from_slice(
        b"ply\nformat binary_little_endian 1.0\ncomment any order\nelement vertex 1\n",
    );
    for name in names.into_iter().chain(["scale_0", "z", "y", "x"]) {
        file.extend_from_slice(format!("property double {name}\n").as_bytes());
    }
    file.extend_from_slice(b"property uchar extra\nend_header\n");
    for value in 0..14 {
        file.extend_from_slice(&f64::from(value).to_le_bytes());
    }
    file.push(0);
    let (splats, notes) = from_bytes(&file).unwrap();
    assert_eq!(notes, ["properties that are not used: extra"]);
    assert_eq!(splats.rotations_wxyz, [[3.0, 2.0, 1.0, 0.0]]);
    assert_eq!(
        (splats.sh, splats.opacity_logits),
        (vec![[6.0, 5.0, 4.0]], vec![7.0])
    );
    assert_eq!(
        (splats.log_scales, splats.means),
        (vec![[10.0, 9.0, 8.0]], vec![[13.0, 12.0, 11.0]])
    );
}

#[test]
fn broken_files_are_rejected_with_the_reason() {
    let mut file = Vec::new();
    write_to(&mut file, &cloud_of_degree(0)).unwrap();
    let error_of = |bytes: &[u8]| from_bytes(bytes).unwrap_err();
    assert!(
        error_of(&file[..file.len() - 1]).contains("truncated: fewer than 5 rows of \"vertex\"")
    );
    assert!(error_of(b"solid").contains("no PLY header"));
    let text = String::from_utf8_lossy(&file).into_owned();
    assert!(
        error_of(text.replace("binary_little_endian", "utf8").as_bytes())
            .contains("unknown format \"utf8\"")
    );
    let binary_in_text = text
        .replace("binary_little_endian", "ascii")
        .replace("vertex 5", "vertex 1");
    assert!(
        error_of(&[binary_in_text.as_bytes(), &b" x ".repeat(20)].concat())
            .contains("is not a valid F32")
    );
    assert!(
        error_of(text.replace("opacity", "opacitx").as_bytes()).contains("no property \"opacity\"")
    );
    assert!(
        error_of(
            text.replace("vertex 5", "vertex 99999999999999999999")
                .as_bytes()
        )
        .contains("not a number")
    );
    assert!(
        error_of(
            text.replace("vertex 5", "vertex 9999999999999999999")
                .as_bytes()
        )
        .contains("truncated")
    );
    let folder = tempfile::tempdir().unwrap();
    let mut not_finite = cloud_of_degree(0);
    not_finite.means[2][0] = f32::NAN;
    not_finite.rotations_wxyz[3] = [0.0; 4];
    not_finite.opacity_logits[4] = f32::INFINITY;
    let path = folder.path().join("nan.ply");
    write(&path, &not_finite).unwrap();
    let read_back = read(&path).unwrap();
    assert_eq!(
        (read_back.n_splats(), read_back.opacity_logits[2]),
        (3, 30.0),
        "two are left out, and one is limited"
    );
    not_finite.means.fill([f32::NAN; 3]);
    write(&path, &not_finite).unwrap();
    assert_eq!(
        read(&path).unwrap_err().to_string(),
        "splats: mean of splat 0 is not finite"
    );
    assert!(matches!(
        write(&folder.path().join("none/splats.ply"), &not_finite),
        Err(Error::Write { .. })
    ));
}

#[test]
fn packed_files_of_another_program_are_read() {
    let Some(folder) = test_support::data_folder("splats") else {
        return;
    };
    let small = read(&folder.join("test.ply")).unwrap();
    assert_eq!((small.n_splats(), small.sh_degree), (64, 3));
    // The bounds of the file's only chunk.
    let bounds = [-1.3947..=0.0, -0.8957..=0.0, 0.0..=0.5489];
    assert!(
        small
            .means
            .iter()
            .all(|mean| (0..3).all(|axis| bounds[axis].contains(&mean[axis])))
    );
    let guitar = read(&folder.join("guitar.compressed.ply")).unwrap();
    assert_eq!(guitar.n_splats(), 90_854);
    let norms = guitar
        .rotations_wxyz
        .iter()
        .map(|wxyz| wxyz.iter().map(|part| part * part).sum::<f32>());
    assert!(norms.into_iter().all(|norm| (norm - 1.0).abs() < 1e-5));
}

#[test]
fn packed_file_with_missing_colors_is_rejected() {
    let seed = |name: &str| {
        std::fs::read(format!(
            "{}/../../fuzz/seeds/model/{name}",
            env!("CARGO_MANIFEST_DIR")
        ))
        .unwrap()
    };
    assert_eq!(
        from_bytes(&seed("ply-packed")[1..]).unwrap().0.n_splats(),
        2
    );
    let error = from_bytes(&seed("ply-packed-colours-missing")[1..]).unwrap_err();
    assert_eq!(error, "element \"sh\" has 1 rows, expected 2");
}

/// The same splats in each format, with Windows line endings, and with faces after or before the
/// vertices.
#[test]
fn every_format_gives_the_same_splats() {
    let cloud = cloud_of_degree(1);
    let mut file = Vec::new();
    write_to(&mut file, &cloud).unwrap();
    let end = b"end_header\n";
    let start = file
        .windows(end.len())
        .position(|window| window == end)
        .unwrap()
        + end.len();
    let (header, rows) = (
        String::from_utf8(file[..start].to_vec()).unwrap(),
        &file[start..],
    );
    let numbers: Vec<f32> = rows
        .as_chunks()
        .0
        .iter()
        .map(|bytes| f32::from_le_bytes(*bytes))
        .collect();
    let in_text = |row: &[f32]| {
        row.iter()
            .map(|number| format!("{number:?} "))
            .collect::<String>()
            + "\n"
    };
    let text: String = numbers
        .chunks(numbers.len() / cloud.n_splats())
        .map(in_text)
        .collect();
    let big_endian: Vec<u8> = numbers
        .iter()
        .flat_map(|number| number.to_be_bytes())
        .collect();
    let format = |name: &str| header.replace("binary_little_endian", name);
    let with_faces = header.replace(
        "end_header",
        "element face 2\nproperty list uchar int vertex_indices\nend_header",
    );
    let faces = [3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 1, 9, 0, 0, 0];
    let first = header.replace(
        "element vertex",
        "element face 2\nproperty list uchar int vertex_indices\nelement vertex",
    );
    let lists = "element face 2\nproperty uchar flags\nproperty list uchar int vertex_indices\nproperty short material\n\
                 property list ushort uchar edges\nproperty int last\nelement vertex";
    let lists_first = |name: &str| format(name).replace("element vertex", lists);
    let listed = [
        1, 2, 0, 0, 0, 0, 1, 0, 0, 0, 7, 0, 1, 0, 9, 5, 0, 0, 0, 0, 0, 7, 0, 2, 0, 8, 9, 5, 0, 0, 0,
    ];
    let listed_big_endian = [
        1, 2, 0, 0, 0, 0, 0, 0, 0, 1, 0, 7, 0, 1, 9, 0, 0, 0, 5, 0, 0, 0, 7, 0, 2, 8, 9, 0, 0, 0, 5,
    ];
    for (what, file) in [
        (
            "text",
            [format("ascii").as_bytes(), text.as_bytes()].concat(),
        ),
        (
            "big-endian",
            [format("binary_big_endian").as_bytes(), &big_endian].concat(),
        ),
        (
            "Windows",
            [header.replace('\n', "\r\n").as_bytes(), rows].concat(),
        ),
        (
            "faces after",
            [with_faces.as_bytes(), rows, &faces].concat(),
        ),
        (
            "faces cut off",
            [with_faces.as_bytes(), rows, &faces[..7]].concat(),
        ),
        ("faces before", [first.as_bytes(), &faces, rows].concat()),
        (
            "faces before in text",
            [
                first.replace("binary_little_endian", "ascii").as_bytes(),
                b"3 0 1 2\n1 9\n",
                text.as_bytes(),
            ]
            .concat(),
        ),
        (
            "several lists",
            [
                lists_first("binary_little_endian").as_bytes(),
                &listed,
                rows,
            ]
            .concat(),
        ),
        (
            "several lists, big-endian",
            [
                lists_first("binary_big_endian").as_bytes(),
                &listed_big_endian,
                &big_endian,
            ]
            .concat(),
        ),
        (
            "several lists in text",
            [
                lists_first("ascii").as_bytes(),
                b"1 2 0 1 7 1 9 5\n0 0 7 2 8 9 5\n",
                text.as_bytes(),
            ]
            .concat(),
        ),
    ] {
        assert_eq!(
            from_bytes(&file).unwrap_or_else(|reason| panic!("{what}: {reason}")),
            (cloud.clone(), vec![]),
            "{what}"
        );
    }
}

/// A text file with one splat of these properties and numbers.
fn one_splat(numbers: &[(&str, &str)], comment: &str) -> Vec<u8> {
    let properties = numbers.iter().map(|(name, number)| {
        let number_type = if number.contains('.') {
            "float"
        } else {
            "uchar"
        };
        format!("property {number_type} {name}\n")
    });
    let row: String = numbers
        .iter()
        .map(|(_, number)| format!("{number} "))
        .collect();
    format!(
        "ply\nformat ascii 1.0\n{comment}element vertex 1\n{}end_header\n{row}\n",
        properties.collect::<String>()
    )
    .into_bytes()
}

const GEOMETRY: [(&str, &str); 11] = [
    ("x", "1.0"),
    ("y", "2.0"),
    ("z", "3.0"),
    ("opacity", "0.5"),
    ("scale_0", "-1.0"),
    ("scale_1", "-2.0"),
    ("rot_0", "1.0"),
    ("rot_1", "0.0"),
    ("rot_2", "0.0"),
    ("rot_3", "0.0"),
    ("scale_2", "-3.0"),
];
const COEFFICIENTS: [(&str, &str); 3] = [("f_dc_0", "0.1"), ("f_dc_1", "0.2"), ("f_dc_2", "0.3")];

#[test]
fn variants_of_other_programs_are_read() {
    let read = |numbers: &[(&str, &str)]| from_bytes(&one_splat(numbers, "")).unwrap();
    let (plain, notes) = read(&[&GEOMETRY[..], &COEFFICIENTS].concat());
    assert_eq!((plain.log_scales[0], notes.len()), ([-1.0, -2.0, -3.0], 0));
    let (flat, _) = read(&[&GEOMETRY[..10], &COEFFICIENTS].concat());
    assert_eq!(flat.log_scales[0], [-1.0, -2.0, -9.0], "a disk");
    let channels = [("red", "255"), ("green", "0"), ("blue", "51")];
    let (colored, notes) = read(&[&GEOMETRY[..], &channels].concat());
    let color = colored.sh[0].map(|coefficient| SH_0 * coefficient + 0.5);
    assert!(
        (0..3).all(|ix| (color[ix] - [1.0, 0.0, 0.2][ix]).abs() < 1e-6) && notes.is_empty(),
        "{color:?} {notes:?}"
    );
    let (both, notes) = read(&[&GEOMETRY[..], &COEFFICIENTS, &channels].concat());
    assert_eq!(both.sh, plain.sh);
    assert_eq!(notes, ["properties that are not used: red, green, blue"]);
    let (filtered, notes) = read(&[&GEOMETRY[..], &COEFFICIENTS, &[("filter_3D", "0.1")]].concat());
    let variances = [-1.0_f32, -2.0, -3.0].map(|log_scale| (2.0 * log_scale).exp());
    let expected: f32 = variances
        .iter()
        .map(|variance| variance / (variance + 0.01))
        .product::<f32>()
        .sqrt();
    assert!((filtered.opacity(0) / plain.opacity(0) - f64::from(expected)).abs() < 1e-5);
    assert!(
        (filtered.log_scales[0][2] - 0.5 * (variances[2] + 0.01).ln()).abs() < 1e-6
            && notes.is_empty()
    );
    let (mip, notes) = from_bytes(&one_splat(
        &[&GEOMETRY[..], &COEFFICIENTS].concat(),
        "comment SplatRenderMode: mip\n",
    ))
    .unwrap();
    assert!(
        mip.is_antialiased && !plain.is_antialiased && notes.is_empty(),
        "{notes:?}"
    );
    let mut written = Vec::new();
    write_to(&mut written, &mip).unwrap();
    assert_eq!(
        from_bytes(&written).unwrap(),
        (mip, Vec::new()),
        "the mark is kept"
    );
    for (comments, is_antialiased) in [
        ("comment antialiased 1\n", true),
        ("comment antialiased 0\n", false),
        ("comment antialiased 10\n", false),
        (
            "comment SplatRenderMode: mip\ncomment antialiased 0\n",
            false,
        ),
        (
            "comment SplatRenderMode: mip\ncomment SplatRenderMode: default\n",
            false,
        ),
        (
            "comment antialiased 0\ncomment splatrendermode: MIP\ncomment other\n",
            true,
        ),
    ] {
        let (splats, _) = from_bytes(&one_splat(
            &[&GEOMETRY[..], &COEFFICIENTS].concat(),
            comments,
        ))
        .unwrap();
        assert_eq!(splats.is_antialiased, is_antialiased, "{comments}");
    }
    let short = one_splat(&[&GEOMETRY[..], &COEFFICIENTS].concat(), "");
    let row_end = short.len() - 5;
    let why = from_bytes(&[&short[..row_end], b"\n"].concat()).unwrap_err();
    assert!(
        why.contains("row 0 of \"vertex\": it does not have 14 numbers"),
        "{why}"
    );
    let (_, notes) = from_bytes(&[&short[..], b"1 2 3\n"].concat()).unwrap();
    assert_eq!(notes, ["5 bytes after the last row are not used"]);
    let points = from_bytes(&one_splat(&[&GEOMETRY[..3], &channels].concat(), "")).unwrap_err();
    assert!(
        points.starts_with("it is a point cloud or a mesh"),
        "{points}"
    );
    let mesh = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                element face 1\nproperty list uchar int vertex_indices\nproperty int flags\nend_header\n0 0 0\n1 0 5\n";
    assert_eq!(from_bytes(mesh.as_bytes()).unwrap_err(), points);
    let higher: Vec<String> = (0..72).map(|ix| format!("f_rest_{ix}")).collect();
    let higher: Vec<(&str, &str)> = higher.iter().map(|name| (name.as_str(), "0.25")).collect();
    let (fourth, notes) = read(&[&GEOMETRY[..], &COEFFICIENTS, &higher].concat());
    assert_eq!((fourth.sh_degree, fourth.sh.len(), notes.len()), (3, 16, 1));
}
