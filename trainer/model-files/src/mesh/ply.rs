//! Meshes as binary `.ply` (Turk 1994), for other programs.

use super::Mesh;
use crate::Error;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Positions are written as doubles if the origin is farther than this from the world's origin,
/// meters. At this distance, a float has steps of 0.06 mm. Many programs read only floats.
const FAR_M: f64 = 1000.0;

/// Writes a mesh in world, in meters.
pub fn write(path: &Path, mesh: &Mesh) -> Result<(), Error> {
    let written = files::replace(path, |file| {
        let mut file = BufWriter::new(file);
        write_to(&mut file, mesh)?;
        file.flush()
    });
    written.map_err(|source| Error::Write {
        path: path.to_owned(),
        source,
    })
}

fn write_to(file: &mut impl Write, mesh: &Mesh) -> std::io::Result<()> {
    let is_far = mesh.origin_m.iter().any(|along| along.abs() > FAR_M);
    let number_type = if is_far { "double" } else { "float" };
    writeln!(
        file,
        "ply\nformat binary_little_endian 1.0\nelement vertex {}",
        mesh.positions_m.len()
    )?;
    for name in ["x", "y", "z"] {
        writeln!(file, "property {number_type} {name}")?;
    }
    for name in ["nx", "ny", "nz"] {
        writeln!(file, "property float {name}")?;
    }
    for name in ["red", "green", "blue"] {
        writeln!(file, "property uchar {name}")?;
    }
    writeln!(
        file,
        "element face {}\nproperty list uchar int vertex_indices\nend_header",
        mesh.triangles.len()
    )?;
    for (ix, position) in mesh.positions_m.iter().enumerate() {
        for (along, origin) in position.iter().zip(mesh.origin_m) {
            let along = origin + f64::from(*along);
            if is_far {
                file.write_all(&along.to_le_bytes())?;
            } else {
                file.write_all(&numbers::f32_of(along).to_le_bytes())?;
            }
        }
        for along in mesh.normals[ix] {
            file.write_all(&along.to_le_bytes())?;
        }
        file.write_all(&mesh.colors_srgb[ix])?;
    }
    for triangle in &mesh.triangles {
        file.write_all(&[3])?;
        for corner in triangle {
            file.write_all(&corner.to_le_bytes())?;
        }
    }
    Ok(())
}
