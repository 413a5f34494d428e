//! The packed `.ply` layout of `SuperSplat`. A splat takes 16 bytes. The splats of each chunk of
//! 256 splats have common bounds. Higher color coefficients have 8 bits each.

use super::header::{Column, Header, Table};
use super::{SH_0, rest_columns};
use crate::splat::arrays::SplatArrays;

const SPLATS_PER_CHUNK: usize = 256;
/// Size of the range of the higher color coefficients, -4 to 4.
const REST_SPAN: f32 = 8.0;
/// Half a step. Opacities stay at least this far from 0 and 1, where the logit is infinite.
const MIN_OPACITY: f32 = 0.5 / 255.0;

/// Unpacks the splats of a file.
pub(super) fn splats(header: &Header<'_>) -> Result<SplatArrays, String> {
    let chunks = header.table("chunk")?;
    let vertices = header.table("vertex")?;
    if vertices.n_rows().div_ceil(SPLATS_PER_CHUNK) != chunks.n_rows() {
        return Err(format!(
            "{} splats do not match {} chunks of 256",
            vertices.n_rows(),
            chunks.n_rows()
        ));
    }
    let bounds = Bounds::of(&chunks)?;
    let packed = vertices.columns([
        "packed_position",
        "packed_rotation",
        "packed_scale",
        "packed_color",
    ])?;
    // Files without view-dependent colors have no element `sh`.
    let (sh_degree, rest) = if header.has_element("sh") {
        let sh = header.table("sh")?;
        if sh.n_rows() != vertices.n_rows() {
            return Err(format!(
                "element \"sh\" has {} rows, expected {}",
                sh.n_rows(),
                vertices.n_rows()
            ));
        }
        rest_columns(&sh)?
    } else {
        (0, Vec::new())
    };
    let mut splats = SplatArrays {
        sh_degree,
        ..SplatArrays::default()
    };
    for row in 0..vertices.n_rows() {
        let chunk = row / SPLATS_PER_CHUNK;
        let [position, rotation, scale, color] = [0, 1, 2, 3].map(|ix| packed[ix].bits(row));
        splats
            .means
            .push(bounds.position.lerp(chunk, three_fractions(position?)));
        splats.rotations_wxyz.push(rotation_wxyz(rotation?));
        splats
            .log_scales
            .push(bounds.log_scale.lerp(chunk, three_fractions(scale?)));
        // Red is in the highest byte.
        let [red, green, blue, opacity] = color?.to_be_bytes().map(|byte| f32::from(byte) / 255.0);
        let opacity = opacity.clamp(MIN_OPACITY, 1.0 - MIN_OPACITY);
        splats.opacity_logits.push((opacity / (1.0 - opacity)).ln());
        splats.sh.push(
            bounds
                .color(chunk, [red, green, blue])
                .map(|value| (value - 0.5) / SH_0),
        );
        splats.sh.extend((0..rest.len() / 3).map(|ix| {
            std::array::from_fn(|channel| {
                higher_coefficient(rest[channel * (rest.len() / 3) + ix].f32(row))
            })
        }));
    }
    Ok(splats)
}

/// The bounds of each chunk.
struct Bounds<'a> {
    position: PropertyRange<'a>,
    log_scale: PropertyRange<'a>,
    /// `None` in older files, in which colors span 0 to 1.
    color: Option<PropertyRange<'a>>,
}

impl<'a> Bounds<'a> {
    fn of(chunks: &Table<'a>) -> Result<Self, String> {
        Ok(Self {
            position: PropertyRange::of(
                chunks,
                ["min_x", "min_y", "min_z"],
                ["max_x", "max_y", "max_z"],
            )?,
            log_scale: PropertyRange::of(
                chunks,
                ["min_scale_x", "min_scale_y", "min_scale_z"],
                ["max_scale_x", "max_scale_y", "max_scale_z"],
            )?,
            color: PropertyRange::of(
                chunks,
                ["min_r", "min_g", "min_b"],
                ["max_r", "max_g", "max_b"],
            )
            .ok(),
        })
    }

    fn color(&self, chunk: usize, frac: [f32; 3]) -> [f32; 3] {
        self.color
            .as_ref()
            .map_or(frac, |range| range.lerp(chunk, frac))
    }
}

/// Minimum and maximum of three properties in each chunk.
struct PropertyRange<'a> {
    min: [Column<'a>; 3],
    max: [Column<'a>; 3],
}

impl<'a> PropertyRange<'a> {
    /// The columns of these names.
    fn of(chunks: &Table<'a>, min: [&str; 3], max: [&str; 3]) -> Result<Self, String> {
        Ok(Self {
            min: chunks.columns(min)?,
            max: chunks.columns(max)?,
        })
    }

    fn lerp(&self, chunk: usize, frac: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|axis| {
            let min = self.min[axis].f32(chunk);
            let max = self.max[axis].f32(chunk);
            min + (max - min) * frac[axis]
        })
    }
}

/// Unpacks three fractions of 11, 10 and 11 bits, beginning at the highest bits.
fn three_fractions(bits: u32) -> [f32; 3] {
    [frac(bits >> 21, 11), frac(bits >> 11, 10), frac(bits, 11)]
}

/// The lowest `n_bits` bits, scaled to the range 0 to 1.
fn frac(bits: u32, n_bits: u32) -> f32 {
    let largest = (1_u32 << n_bits) - 1;
    (bits & largest) as f32 / largest as f32
}

/// Unpacks a quaternion. The highest two bits select its largest component, which is positive and
/// not stored. The other three have 10 bits each.
fn rotation_wxyz(bits: u32) -> [f32; 4] {
    // The other components of a unit quaternion are at most `1 / sqrt(2)` in size, so 10 bits span
    // this range instead of -1 to 1.
    let largest_ix = (bits >> 30) as usize;
    let others =
        [20, 10, 0].map(|shift| (frac(bits >> shift, 10) - 0.5) * std::f32::consts::SQRT_2);
    // Rounding, or a damaged file, can make the sum exceed 1.
    let squares: f32 = others.iter().map(|part| part * part).sum();
    let mut wxyz = [(1.0 - squares).max(0.0).sqrt(); 4];
    for (part_ix, other) in (0..4).filter(|&ix| ix != largest_ix).zip(others) {
        wxyz[part_ix] = other;
    }
    wxyz
}

/// Decodes a higher color coefficient. Bytes 0 and 255 stand for the ends of the range. Other bytes
/// stand for the center of a step.
fn higher_coefficient(byte: f32) -> f32 {
    let frac = match byte {
        0.0 => 0.0,
        255.0 => 1.0,
        _ => (byte + 0.5) / 256.0,
    };
    (frac - 0.5) * REST_SPAN
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Packs a rotation as specified by the format.
    #[expect(clippy::cast_possible_truncation, reason = "a step of 10 bits")]
    fn packed(wxyz: [f32; 4]) -> u32 {
        let largest_ix = (0..4)
            .max_by(|&a, &b| wxyz[a].abs().total_cmp(&wxyz[b].abs()))
            .unwrap();
        let sign = wxyz[largest_ix].signum();
        let others = (0..4).filter(|&ix| ix != largest_ix);
        others.fold(u32::try_from(largest_ix).unwrap(), |bits, ix| {
            let step = ((sign * wxyz[ix] / std::f32::consts::SQRT_2 + 0.5) * 1023.0).round();
            (bits << 10) | step as u32
        })
    }

    #[test]
    fn rotations_round_trip_for_any_largest_component() {
        for rotation in [
            [0.9, 0.1, -0.3, 0.3],
            [0.1, -0.9, 0.3, 0.3],
            [0.3, 0.1, 0.9, -0.3],
            [-0.3, 0.3, 0.1, 0.9],
        ] {
            let norm = rotation
                .iter()
                .map(|part: &f32| part * part)
                .sum::<f32>()
                .sqrt();
            let rotation = rotation.map(|part| part / norm);
            let got = rotation_wxyz(packed(rotation));
            let dot: f32 = got.iter().zip(rotation).map(|(a, b)| a * b).sum();
            assert!(dot.abs() > 0.999_99, "{rotation:?} became {got:?}");
        }
    }

    #[test]
    fn fractions_use_all_bits() {
        assert_eq!(three_fractions(0x7ff << 21), [1.0, 0.0, 0.0]);
        assert_eq!(three_fractions(0x3ff << 11), [0.0, 1.0, 0.0]);
        assert_eq!(three_fractions(0x7ff), [0.0, 0.0, 1.0]);
        assert_eq!([0.0, 255.0].map(higher_coefficient), [-4.0, 4.0]);
    }
}
