//! Meshes as `.glb` files of glTF 2.0 (Khronos 2021), with one JSON chunk and one binary chunk.

use super::Mesh;
use crate::Error;
use serde_json::json;
use std::path::Path;

/// The letters `glTF`, `JSON` and `BIN` (glTF 2.0, section 4.4), little endian.
const MAGIC: u32 = 0x4654_6c67;
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BIN_CHUNK: u32 = 0x004e_4942;
/// Types of numbers and targets of buffers, which glTF takes from OpenGL.
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const VERTICES: u32 = 34_962;
const INDICES: u32 = 34_963;

/// Writes a mesh. glTF has y up and z toward the viewer, while the world has z up. One node
/// contains this rotation, and another node contains the origin.
pub fn write(path: &Path, mesh: &Mesh) -> Result<(), Error> {
    files::write(path, to_bytes(mesh)).map_err(|source| Error::Write {
        path: path.to_owned(),
        source,
    })
}

/// Encodes the file.
pub(super) fn to_bytes(mesh: &Mesh) -> Vec<u8> {
    let parts = parts(mesh);
    let mut json = description(mesh, &parts).to_string().into_bytes();
    // Chunks begin at multiples of 4 bytes. JSON is padded with spaces.
    json.resize(json.len().next_multiple_of(4), b' ');
    let bin = parts.concat();
    let length = |n: usize| u32::try_from(n).unwrap_or(u32::MAX).to_le_bytes();
    let mut file = Vec::with_capacity(28 + json.len() + bin.len());
    file.extend(MAGIC.to_le_bytes());
    file.extend(2u32.to_le_bytes());
    // An empty binary chunk is left out. The lengths are 8 bytes per chunk header, plus 12 bytes of
    // the file's header.
    let n_chunks_bytes = if bin.is_empty() {
        8 + json.len()
    } else {
        16 + json.len() + bin.len()
    };
    file.extend(length(12 + n_chunks_bytes));
    file.extend(length(json.len()));
    file.extend(JSON_CHUNK.to_le_bytes());
    file.extend(json);
    if !bin.is_empty() {
        file.extend(length(bin.len()));
        file.extend(BIN_CHUNK.to_le_bytes());
        file.extend(bin);
    }
    file
}

/// Positions, normals, colors and indices, each a multiple of 4 bytes.
fn parts(mesh: &Mesh) -> [Vec<u8>; 4] {
    // glTF expects linear vertex colors.
    let colors = mesh
        .colors_srgb
        .iter()
        .flatten()
        .flat_map(|byte| linear(*byte).to_le_bytes())
        .collect();
    let indices = mesh
        .triangles
        .iter()
        .flatten()
        .flat_map(|ix| ix.to_le_bytes())
        .collect();
    [
        float_bytes(&mesh.positions_m),
        float_bytes(&mesh.normals),
        colors,
        indices,
    ]
}

fn float_bytes(values: &[[f32; 3]]) -> Vec<u8> {
    values
        .iter()
        .flatten()
        .flat_map(|value| value.to_le_bytes())
        .collect()
}

/// Linear value of an sRGB byte (IEC 61966-2-1).
fn linear(byte: u8) -> f32 {
    let part = f32::from(byte) / 255.0;
    if part <= 0.04045 {
        part / 12.92
    } else {
        ((part + 0.055) / 1.055).powf(2.4)
    }
}

/// The smallest or largest coordinate of the vertices along each axis, selected by `pick`.
fn extreme(mesh: &Mesh, pick: fn(f32, f32) -> f32, begin: f32) -> Vec<f32> {
    (0..3)
        .map(|axis| {
            mesh.positions_m
                .iter()
                .map(|position| position[axis])
                .fold(begin, pick)
        })
        .collect()
}

fn description(mesh: &Mesh, parts: &[Vec<u8>; 4]) -> serde_json::Value {
    let asset = json!({"version": "2.0", "generator": "fieldrig"});
    // Accessors of length 0 are invalid.
    if mesh.triangles.is_empty() {
        return json!({"asset": asset, "scene": 0, "scenes": [{}]});
    }
    let mut offset = 0;
    let views: Vec<_> = parts
        .iter()
        .zip([VERTICES, VERTICES, VERTICES, INDICES])
        .map(|(part, target)| {
            let view = json!({"buffer": 0, "byteOffset": offset, "byteLength": part.len(), "target": target});
            offset += part.len();
            view
        })
        .collect();
    let n = mesh.positions_m.len();
    let vec3 =
        |view: u32| json!({"bufferView": view, "componentType": FLOAT, "count": n, "type": "VEC3"});
    // Bounds are required for positions, and only for them.
    let mut positions = vec3(0);
    positions["min"] = json!(extreme(mesh, f32::min, f32::INFINITY));
    positions["max"] = json!(extreme(mesh, f32::max, f32::NEG_INFINITY));
    let indices = json!({
        "bufferView": 3, "componentType": UNSIGNED_INT, "count": 3 * mesh.triangles.len(), "type": "SCALAR"
    });
    // A rotation by -90 degrees about x turns z up into y up. The origin is a translation in f64,
    // because positions in f32 lose precision far from it.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    json!({
        "asset": asset,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "world", "rotation": [-half, 0.0, 0.0, half], "children": [1]},
            {"name": "mesh", "translation": mesh.origin_m, "mesh": 0},
        ],
        "meshes": [{"primitives": [{
            "attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0
        }]}],
        "materials": [{"doubleSided": true, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
        "accessors": [positions, vec3(1), vec3(2), indices],
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    })
}
