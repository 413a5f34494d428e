//! Splats in `.ply` files: reads and writes the layout of Kerbl et al. 2023, and reads the packed layout of
//! `SuperSplat`.

mod header;
mod packed;

use crate::Error;
use crate::splat::arrays::SplatArrays;
use header::{Column, Header, Table};
use std::io::{BufWriter, Write};
use std::path::Path;

/// Reads a `.ply` file of splats. Properties may have any order and number type. The number of `f_rest_*` properties
/// determines the SH degree.
pub fn read(path: &Path) -> Result<SplatArrays, Error> {
    let bytes = files::read(path, files::NO_LIMIT).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    from_bytes(&bytes).map_err(|reason| Error::SplatFile { path: path.to_owned(), reason })?.checked()
}

/// Writes a `.ply` file of splats as little-endian f32. A failed write leaves no partial file at `path`.
pub fn write(path: &Path, splats: &SplatArrays) -> Result<(), Error> {
    let written = files::replace(path, |file| {
        let mut file = BufWriter::new(file);
        write_to(&mut file, splats)?;
        file.flush()
    });
    written.map_err(|source| Error::Write { path: path.to_owned(), source })
}

fn from_bytes(bytes: &[u8]) -> Result<SplatArrays, String> {
    let header = Header::parse(bytes)?;
    if header.has_element("chunk") {
        return packed::splats(&header, bytes);
    }
    let vertices = header.table("vertex", bytes)?;
    let [means, log_scales] = [["x", "y", "z"], ["scale_0", "scale_1", "scale_2"]].map(|names| vertices.columns(names));
    let rotations = vertices.columns(["rot_0", "rot_1", "rot_2", "rot_3"])?;
    let opacity = vertices.column("opacity")?;
    let color = ColorColumns::of(&vertices, &vertices)?;
    let (means, log_scales) = (means?, log_scales?);
    let rows = 0..vertices.n_rows();
    Ok(SplatArrays {
        means: rows.clone().map(|row| means.each_ref().map(|column| column.f32(row))).collect(),
        log_scales: rows.clone().map(|row| log_scales.each_ref().map(|column| column.f32(row))).collect(),
        rotations_wxyz: rows.clone().map(|row| rotations.each_ref().map(|column| column.f32(row))).collect(),
        opacity_logits: rows.clone().map(|row| opacity.f32(row)).collect(),
        sh: rows.flat_map(|row| color.coefficients(row)).collect(),
        sh_degree: color.degree,
    })
}

/// The columns of the color coefficients. Files store all higher coefficients of red, then of green, then of blue.
struct ColorColumns<'a> {
    degree: u32,
    constant: [Column<'a>; 3],
    rest: Vec<Column<'a>>,
}

impl<'a> ColorColumns<'a> {
    fn of(constant: &Table<'a>, rest: &Table<'a>) -> Result<Self, String> {
        let (degree, rest) = rest_columns(rest)?;
        Ok(Self { degree, constant: constant.columns(["f_dc_0", "f_dc_1", "f_dc_2"])?, rest })
    }

    fn coefficients(&self, row: usize) -> Vec<[f32; 3]> {
        let n_rest = self.rest.len() / 3;
        let constant = self.constant.each_ref().map(|column| column.f32(row));
        let rest = (0..n_rest).map(|ix| std::array::from_fn(|color| self.rest[color * n_rest + ix].f32(row)));
        std::iter::once(constant).chain(rest).collect()
    }
}

/// SH degree and the columns `f_rest_*`.
fn rest_columns<'a>(table: &Table<'a>) -> Result<(u32, Vec<Column<'a>>), String> {
    let rest: Vec<_> = (0..).map_while(|ix| table.column(&format!("f_rest_{ix}")).ok()).collect();
    let degree = match rest.len() {
        0 => 0,
        9 => 1,
        24 => 2,
        45 => 3,
        other => return Err(format!("found {other} f_rest_* properties, expected 0, 9, 24 or 45")),
    };
    Ok((degree, rest))
}

fn write_to(file: &mut impl Write, splats: &SplatArrays) -> std::io::Result<()> {
    let n_coefficients = splats.n_coefficients();
    let rest = (0..3 * (n_coefficients - 1)).map(|ix| format!("f_rest_{ix}"));
    let before = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(str::to_owned);
    let after = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].map(str::to_owned);
    writeln!(file, "ply\nformat binary_little_endian 1.0\nelement vertex {}", splats.n_splats())?;
    for name in before.into_iter().chain(rest).chain(after) {
        writeln!(file, "property float {name}")?;
    }
    writeln!(file, "end_header")?;
    for (splat_ix, color) in splats.sh.chunks_exact(n_coefficients).enumerate() {
        let no_normal = [0.0; 3];
        let rest = (0..3).flat_map(|channel| color[1..].iter().map(move |coefficient| coefficient[channel]));
        let values = splats.means[splat_ix].into_iter().chain(no_normal).chain(color[0]).chain(rest);
        let values = values.chain([splats.opacity_logits[splat_ix]]).chain(splats.log_scales[splat_ix]);
        for value in values.chain(splats.rotations_wxyz[splat_ix]) {
            file.write_all(&value.to_le_bytes())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
