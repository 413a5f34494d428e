//! Splats in `.ply` files. This module reads and writes the layout of Kerbl et al. 2023, and reads
//! the packed layout of `SuperSplat`. It also reads point clouds.

mod header;
mod packed;
mod points;

pub use points::read_points;

use crate::Error;
use crate::splat::arrays::SplatArrays;
use header::{Column, Header, Table};
use std::io::{BufWriter, Write};
use std::path::Path;

/// Constant factor of the first spherical harmonic, `1 / (2 sqrt(pi))`.
pub(super) const SH_0: f32 = 0.282_094_8;
/// Thickness of a flat splat (2D Gaussian splatting), relative to its smaller radius, as a
/// logarithm. It corresponds to one thousandth. This is thin enough to be invisible from the side,
/// and thick enough for a covariance that is invertible in f32.
const LOG_FLATNESS: f32 = -7.0;
/// Properties of splats that are not used. They are normals, which are zero in these files, and
/// properties of other programs that do not affect pictures.
const UNUSED: [&str; 5] = ["nx", "ny", "nz", "label", "id"];

/// Reads a `.ply` file of splats. Properties may have any order and number type, and the file may
/// have any format of PLY. The number of `f_rest_*` properties determines the SH degree.
///
/// Splats with invalid numbers are left out. Warnings report them, and also report properties that
/// are not used.
pub fn read(path: &Path) -> Result<SplatArrays, Error> {
    super::read_with(path, from_bytes)
}

/// Writes a `.ply` file of splats as little-endian f32. A failed write leaves no partial file at
/// `path`.
pub fn write(path: &Path, splats: &SplatArrays) -> Result<(), Error> {
    let written = files::replace(path, |file| {
        let mut file = BufWriter::new(file);
        write_to(&mut file, splats)?;
        file.flush()
    });
    written.map_err(|source| Error::Write {
        path: path.to_owned(),
        source,
    })
}

/// The splats, and notes about what is not used.
fn from_bytes(bytes: &[u8]) -> Result<(SplatArrays, Vec<String>), String> {
    let header = Header::parse(bytes)?;
    let mut notes: Vec<String> = note_of_unread(&header).into_iter().collect();
    let is_antialiased = is_antialiased(header.comments());
    // Only the packed layout of SuperSplat has chunks.
    if header.has_element("chunk") {
        return Ok((
            SplatArrays {
                is_antialiased,
                ..packed::splats(&header)?
            },
            notes,
        ));
    }
    // Point clouds and meshes have the same extension. Naming them is more useful than naming the
    // first missing property.
    let vertices = header.table("vertex")?;
    let names: Vec<&str> = vertices.names().collect();
    let is_splat =
        |name: &&str| name.starts_with("scale_") || name.starts_with("rot_") || *name == "opacity";
    if !names.iter().any(is_splat) {
        return Err(
            "it is a point cloud or a mesh: its vertices have no scales, rotations and opacities"
                .to_owned(),
        );
    }
    let means = vertices.columns(["x", "y", "z"])?;
    let scales = Scales::of(&vertices)?;
    let rotations = vertices.columns(["rot_0", "rot_1", "rot_2", "rot_3"])?;
    let opacity = vertices.column("opacity")?;
    let color = ColorColumns::of(&vertices)?;
    notes.extend(color.note());
    let filter = vertices.column("filter_3D").ok();
    // A property that fieldrig does not know may change how the splats look.
    let unused: Vec<&str> = names
        .iter()
        .copied()
        .filter(|name| !is_used(name, &color))
        .collect();
    notes.extend(note_of_unused(&unused));
    let rows = 0..vertices.n_rows();
    let mut splats = SplatArrays {
        means: rows
            .clone()
            .map(|row| means.each_ref().map(|column| column.f32(row)))
            .collect(),
        log_scales: rows.clone().map(|row| scales.log_scales(row)).collect(),
        rotations_wxyz: rows
            .clone()
            .map(|row| rotations.each_ref().map(|column| column.f32(row)))
            .collect(),
        opacity_logits: rows.clone().map(|row| opacity.f32(row)).collect(),
        sh: rows
            .clone()
            .flat_map(|row| color.coefficients(row))
            .collect(),
        sh_degree: color.degree,
        is_antialiased,
    };
    // The filter is applied last, because it changes scales and opacities that were read before.
    if let Some(filter) = filter {
        rows.for_each(|row| widen(&mut splats, row, filter.f32(row)));
    }
    Ok((splats, notes))
}

/// Note about bytes after the last row, if there are any.
fn note_of_unread(header: &Header<'_>) -> Option<String> {
    let n_unread = header.n_unread();
    (n_unread > 0).then(|| format!("{n_unread} bytes after the last row are not used"))
}

/// Note about properties that are not used, if there are any.
fn note_of_unused(names: &[&str]) -> Option<String> {
    (!names.is_empty()).then(|| format!("properties that are not used: {}", names.join(", ")))
}

/// Whether the comments name the opacity correction of Mip-Splatting, as Brush (`SplatRenderMode:
/// mip`) and Postshot (`antialiased 1`) do. The last such comment counts.
fn is_antialiased(comments: &[String]) -> bool {
    let by_comment = |comment: &String| match comment.to_ascii_lowercase().replace(' ', "").as_str()
    {
        "splatrendermode:mip" | "antialiased1" => Some(true),
        "splatrendermode:default" | "splatrendermode:2dgs" | "antialiased0" => Some(false),
        _ => None,
    };
    comments.iter().rev().find_map(by_comment).unwrap_or(false)
}

fn is_used(name: &str, color: &ColorColumns<'_>) -> bool {
    let is_color = match color.constant {
        ConstantColor::Coefficients(_) => name.starts_with("f_dc_"),
        ConstantColor::Channels(_) => ["red", "green", "blue"].contains(&name),
    };
    let known = ["x", "y", "z", "opacity", "filter_3D"];
    is_color
        || known.contains(&name)
        || UNUSED.contains(&name)
        || ["scale_", "rot_", "f_rest_"]
            .iter()
            .any(|start| name.starts_with(start))
}

/// Applies the 3D filter of Mip-Splatting (Yu et al. 2024), as its renderer does. Adds the variance
/// of the filter to the variance along each axis. Multiplies the opacity by the ratio of the old
/// volume to the new volume.
fn widen(splats: &mut SplatArrays, row: usize, filter_m: f32) {
    let variances = splats.log_scales[row].map(|log_scale| (2.0 * log_scale).exp());
    let widened = variances.map(|variance| variance + filter_m * filter_m);
    // The volume is the square root of the determinant of the covariance.
    let ratio = variances
        .iter()
        .zip(&widened)
        .map(|(before, after)| before / after)
        .product::<f32>()
        .sqrt();
    let opacity = ratio / (1.0 + (-splats.opacity_logits[row]).exp());
    splats.log_scales[row] = widened.map(|variance| 0.5 * variance.ln());
    splats.opacity_logits[row] = (opacity / (1.0 - opacity)).ln();
}

/// The columns of the scales.
enum Scales<'a> {
    Solid([Column<'a>; 3]),
    /// Disks of 2D Gaussian splatting (Huang et al. 2024). Their normal is the third axis.
    Flat([Column<'a>; 2]),
}

impl<'a> Scales<'a> {
    fn of(vertices: &Table<'a>) -> Result<Self, String> {
        match vertices.columns(["scale_0", "scale_1", "scale_2"]) {
            Ok(columns) => Ok(Self::Solid(columns)),
            // If even two scales are missing, the error names one of them.
            Err(_) => vertices.columns(["scale_0", "scale_1"]).map(Self::Flat),
        }
    }

    fn log_scales(&self, row: usize) -> [f32; 3] {
        match self {
            Self::Solid(columns) => columns.each_ref().map(|column| column.f32(row)),
            Self::Flat(columns) => {
                // A sum of logarithms is a product of lengths.
                let [a, b] = columns.each_ref().map(|column| column.f32(row));
                [a, b, a.min(b) + LOG_FLATNESS]
            }
        }
    }
}

/// The columns of the color coefficients. Files store all higher coefficients of red, then of
/// green, then of blue.
struct ColorColumns<'a> {
    degree: u32,
    constant: ConstantColor<'a>,
    rest: Vec<Column<'a>>,
    /// Number of higher coefficients per channel in the file. If the file has a higher degree, not
    /// all of them are used.
    n_rest: usize,
}

enum ConstantColor<'a> {
    Coefficients([Column<'a>; 3]),
    /// Red, green and blue of the splat, without a dependence on the direction.
    Channels([Column<'a>; 3]),
}

impl<'a> ColorColumns<'a> {
    fn of(vertices: &Table<'a>) -> Result<Self, String> {
        let (degree, rest) = rest_columns(vertices)?;
        let n_rest = rest.len() / 3;
        let constant = match vertices.columns(["f_dc_0", "f_dc_1", "f_dc_2"]) {
            Ok(columns) => ConstantColor::Coefficients(columns),
            // Some programs write plain vertex colors. If these are also missing, the error names
            // the usual properties.
            Err(missing) => {
                let channels = vertices
                    .columns(["red", "green", "blue"])
                    .map_err(|_| missing)?;
                ConstantColor::Channels(channels)
            }
        };
        Ok(Self {
            degree,
            constant,
            rest,
            n_rest,
        })
    }

    fn note(&self) -> Option<String> {
        let n_used = (self.degree as usize + 1).pow(2) - 1;
        (self.n_rest > n_used)
            .then(|| "its color coefficients above degree 3 are not used".to_owned())
    }

    fn coefficients(&self, row: usize) -> Vec<[f32; 3]> {
        let constant = match &self.constant {
            ConstantColor::Coefficients(columns) => {
                columns.each_ref().map(|column| column.f32(row))
            }
            ConstantColor::Channels(columns) => columns
                .each_ref()
                .map(|column| (column.channel(row) - 0.5) / SH_0),
        };
        // The file stores one plane per channel. They are rearranged to one color per coefficient.
        let n_used = (self.degree as usize + 1).pow(2) - 1;
        let rest = (0..n_used)
            .map(|ix| std::array::from_fn(|color| self.rest[color * self.n_rest + ix].f32(row)));
        std::iter::once(constant).chain(rest).collect()
    }
}

/// SH degree that is used, and the columns `f_rest_*`.
fn rest_columns<'a>(table: &Table<'a>) -> Result<(u32, Vec<Column<'a>>), String> {
    let rest: Vec<_> = (0..)
        .map_while(|ix| table.column(&format!("f_rest_{ix}")).ok())
        .collect();
    // There are three channels of `(degree + 1)^2 - 1` coefficients. A file of degree 4, with 72
    // coefficients, is read as degree 3.
    let degree = match rest.len() {
        0 => 0,
        9 => 1,
        24 => 2,
        45 | 72 => 3,
        other => {
            return Err(format!(
                "found {other} f_rest_* properties, expected 0, 9, 24, 45 or 72"
            ));
        }
    };
    Ok((degree, rest))
}

fn write_to(file: &mut impl Write, splats: &SplatArrays) -> std::io::Result<()> {
    let n_coefficients = splats.n_coefficients();
    let rest = (0..3 * (n_coefficients - 1)).map(|ix| format!("f_rest_{ix}"));
    let before = [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2",
    ]
    .map(str::to_owned);
    let after = [
        "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]
    .map(str::to_owned);
    // The comment is the same as in files of Brush, so that other programs also apply the opacity
    // correction.
    let comment = if splats.is_antialiased {
        "comment SplatRenderMode: mip\n"
    } else {
        ""
    };
    writeln!(
        file,
        "ply\nformat binary_little_endian 1.0\n{comment}element vertex {}",
        splats.n_splats()
    )?;
    for name in before.into_iter().chain(rest).chain(after) {
        writeln!(file, "property float {name}")?;
    }
    writeln!(file, "end_header")?;
    for (splat_ix, color) in splats.sh.chunks_exact(n_coefficients).enumerate() {
        // The layout has normals, which splats do not have. Readers expect zeros.
        let no_normal = [0.0; 3];
        let rest = (0..3).flat_map(|channel| {
            color[1..]
                .iter()
                .map(move |coefficient| coefficient[channel])
        });
        let values = splats.means[splat_ix]
            .into_iter()
            .chain(no_normal)
            .chain(color[0])
            .chain(rest);
        let values = values
            .chain([splats.opacity_logits[splat_ix]])
            .chain(splats.log_scales[splat_ix]);
        for value in values.chain(splats.rotations_wxyz[splat_ix]) {
            file.write_all(&value.to_le_bytes())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
