//! Tests of the files of meshes.

use super::{Mesh, write_glb, write_ply};

/// A pyramid with four sides, away from the world's origin.
fn pyramid() -> Mesh {
    let slanted = std::f32::consts::FRAC_1_SQRT_2;
    Mesh {
        origin_m: [0.31, -0.22, 0.13],
        positions_m: vec![
            [0.25, 0.0, 0.0],
            [0.0, 0.25, 0.0],
            [-0.25, 0.0, 0.0],
            [0.0, -0.25, 0.0],
            [0.0, 0.0, 0.25],
        ],
        normals: vec![
            [slanted, 0.0, -slanted],
            [0.0, slanted, -slanted],
            [-slanted, 0.0, -slanted],
            [0.0, -slanted, -slanted],
            [0.0, 0.0, 1.0],
        ],
        colors_srgb: vec![
            [255, 0, 0],
            [0, 255, 0],
            [0, 0, 255],
            [128; 3],
            [7, 200, 90],
        ],
        triangles: vec![
            [0, 1, 4],
            [1, 2, 4],
            [2, 3, 4],
            [3, 0, 4],
            [2, 1, 0],
            [3, 2, 0],
        ],
    }
}

/// The text of the header, and the bytes after it.
fn ply_parts(bytes: &[u8]) -> (String, &[u8]) {
    let end = bytes
        .windows(11)
        .position(|window| window == b"end_header\n")
        .unwrap()
        + 11;
    (
        String::from_utf8(bytes[..end].to_vec()).unwrap(),
        &bytes[end..],
    )
}

#[test]
fn ply_and_glb_files_hold_the_mesh() {
    let mesh = pyramid();
    let folder = tempfile::tempdir().unwrap();
    let ply = folder.path().join("mesh.ply");
    let glb = folder.path().join("mesh.glb");
    write_ply(&ply, &mesh).unwrap();
    write_glb(&glb, &mesh).unwrap();
    let bytes = std::fs::read(ply).unwrap();
    let (header, body) = ply_parts(&bytes);
    assert!(header.contains(&format!("element vertex {}\n", mesh.positions_m.len())));
    assert!(header.contains(&format!("element face {}\n", mesh.triangles.len())));
    assert_eq!(
        body.len(),
        27 * mesh.positions_m.len() + 13 * mesh.triangles.len()
    );

    let bytes = std::fs::read(glb).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!(
        (&bytes[..4], word(4), word(8)),
        (&b"glTF"[..], 2, bytes.len())
    );
    assert_eq!(&bytes[16..20], b"JSON");
    let json: serde_json::Value = serde_json::from_slice(&bytes[20..20 + word(12)]).unwrap();
    let bin = 20 + word(12);
    assert_eq!(&bytes[bin + 4..bin + 8], b"BIN\0");
    assert_eq!(json["buffers"][0]["byteLength"], word(bin));
    assert_eq!(bytes.len(), bin + 8 + word(bin));
    let views = json["bufferViews"].as_array().unwrap();
    let lengths: Vec<_> = views
        .iter()
        .map(|view| view["byteLength"].as_u64().unwrap())
        .collect();
    let n = mesh.positions_m.len() as u64;
    assert_eq!(
        lengths,
        [12 * n, 12 * n, 12 * n, 12 * mesh.triangles.len() as u64]
    );
    let first = bin + 8;
    let x = f32::from_le_bytes(bytes[first..first + 4].try_into().unwrap());
    assert_eq!(x.to_bits(), mesh.positions_m[0][0].to_bits());
    assert_eq!(
        json["nodes"][1]["translation"],
        serde_json::json!(mesh.origin_m)
    );
    let empty = super::glb::to_bytes(&Mesh::default());
    assert_eq!(
        u32::from_le_bytes(empty[8..12].try_into().unwrap()) as usize,
        empty.len()
    );
}
