//! Point clouds in `.ply` files. Points have positions, and may have colors.

use super::header::{Column, Header};
use super::{UNUSED, note_of_unread, note_of_unused};
use crate::{Error, InitialPoints};
use files::Budget;
use std::path::Path;

/// Larger coordinates, in meters, count as mistakes. The positions of cameras have the same limit.
const MAX_COORDINATE_M: f32 = 1e4;
const COORDINATES: [&str; 3] = ["x", "y", "z"];
const CHANNELS: [&str; 3] = ["red", "green", "blue"];

/// Reads a `.ply` file of points, in any format of PLY. The vertices of a mesh are also points.
/// Also returns notes for the user about everything that is not used.
///
/// Reads the properties `x`, `y`, `z`, `red`, `green` and `blue`, which may have any number type.
/// Points whose coordinates are not finite or exceed 10 km are left out.
///
/// # Errors
/// Fails if the file cannot be read, is not a PLY file, contains splats, or contains no usable
/// point.
pub fn read_points(path: &Path) -> Result<(InitialPoints, Vec<String>), Error> {
    let bytes = files::read(path, Budget::POINTS).map_err(|source| Error::Read {
        path: path.to_owned(),
        source,
    })?;
    points_from_bytes(&bytes).map_err(|reason| Error::SplatFile {
        path: path.to_owned(),
        reason,
    })
}

fn points_from_bytes(bytes: &[u8]) -> Result<(InitialPoints, Vec<String>), String> {
    let header = Header::parse(bytes)?;
    let vertices = header.table("vertex")?;
    let names: Vec<&str> = vertices.names().collect();
    // Splats also have positions, but a user who gives a model instead of points has mixed up the
    // files.
    if header.has_element("chunk") || names.iter().any(|name| is_of_splat(name)) {
        return Err("it is a splat model, expected a point cloud".to_owned());
    }
    // Colors are used only if all three channels are present.
    let coordinates = vertices.columns(COORDINATES)?;
    let channels = vertices.columns(CHANNELS).ok();
    let mut notes: Vec<String> = note_of_unread(&header).into_iter().collect();
    let is_color = |name: &&str| channels.is_some() && CHANNELS.contains(name);
    let is_unused =
        |name: &&str| !COORDINATES.contains(name) && !UNUSED.contains(name) && !is_color(name);
    let unused: Vec<&str> = names.iter().copied().filter(is_unused).collect();
    notes.extend(note_of_unused(&unused));

    let n_all = vertices.n_rows();
    let mut points = InitialPoints::default();
    for row in 0..n_all {
        let position = coordinates.each_ref().map(|column| column.f32(row));
        // The comparison also excludes NaN.
        if position
            .iter()
            .all(|coordinate| coordinate.abs() <= MAX_COORDINATE_M)
        {
            points.points_in_world_m.push(position);
            points
                .colors_srgb
                .extend(channels.as_ref().map(|channels| color_at(channels, row)));
        }
    }
    let n_left_out = n_all - points.points_in_world_m.len();
    let reason = "their coordinates are not finite or exceed 10000 m";
    match (points.points_in_world_m.len(), n_left_out) {
        (0, 0) => return Err("it contains no points".to_owned()),
        (0, _) => return Err(format!("none of {n_all} points can be used: {reason}")),
        (_, 0) => {}
        (_, n_left_out) => notes.push(format!("left out {n_left_out} of {n_all} points: {reason}")),
    }
    Ok((points, notes))
}

/// Whether only splats have a property of this name.
fn is_of_splat(name: &str) -> bool {
    ["scale_", "rot_", "f_dc_"]
        .iter()
        .any(|start| name.starts_with(start))
}

fn color_at(channels: &[Column<'_>; 3], row: usize) -> [u8; 3] {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "from 0 to 255; the cast maps NaN to 0"
    )]
    let byte_of = |channel: f32| (255.0 * channel.clamp(0.0, 1.0)).round() as u8;
    channels
        .each_ref()
        .map(|column| byte_of(column.channel(row)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splat::cloud::synthetic_cloud;
    use crate::splat::ply;

    const POSITIONS: [[f32; 3]; 3] = [[1.0, -2.5, 0.25], [0.0, 4.0, -8.0], [100.5, 0.0, 3.0]];
    const COLORS: [[u8; 3]; 3] = [[255, 0, 51], [1, 2, 3], [128, 254, 9]];
    const COLOR_PROPERTIES: &str =
        "property uchar red\nproperty uint8 green\nproperty uchar blue\n";

    fn header(format: &str, n: usize, more: &str) -> String {
        let positions = "property float x\nproperty float32 y\nproperty float z\n";
        format!("ply\nformat {format} 1.0\nelement vertex {n}\n{positions}{more}end_header\n")
    }

    /// A text file with these rows of x, y and z.
    fn text_of(rows: &[&str]) -> Vec<u8> {
        format!("{}{}\n", header("ascii", rows.len(), ""), rows.join("\n")).into_bytes()
    }

    #[test]
    fn every_format_gives_the_same_points() {
        let bytes_of = |bytes_of_number: fn(f32) -> [u8; 4]| -> Vec<u8> {
            let row = |(position, color): (&[f32; 3], &[u8; 3])| {
                let numbers: Vec<u8> = position
                    .iter()
                    .flat_map(|number| bytes_of_number(*number))
                    .collect();
                [&numbers[..], color].concat()
            };
            POSITIONS.iter().zip(&COLORS).flat_map(row).collect()
        };
        let line =
            |([x, y, z], [r, g, b]): (&[f32; 3], &[u8; 3])| format!("{x} {y} {z} {r} {g} {b}\n");
        let text: String = POSITIONS.iter().zip(&COLORS).map(line).collect();
        let expected = InitialPoints {
            points_in_world_m: POSITIONS.to_vec(),
            colors_srgb: COLORS.to_vec(),
        };
        for (format, rows) in [
            ("ascii", text.into_bytes()),
            ("binary_little_endian", bytes_of(f32::to_le_bytes)),
            ("binary_big_endian", bytes_of(f32::to_be_bytes)),
        ] {
            let header = header(format, 3, COLOR_PROPERTIES);
            let file = [header.as_bytes(), &rows].concat();
            assert_eq!(
                points_from_bytes(&file),
                Ok((expected.clone(), Vec::new())),
                "{format}"
            );
            let renamed = header.replace("property float z", "property float w");
            let reason = points_from_bytes(&[renamed.as_bytes(), &rows].concat()).unwrap_err();
            assert!(reason.contains("no property \"z\""), "{format}: {reason}");
        }
    }

    #[test]
    fn colors_are_optional_and_other_properties_are_named() {
        let (plain, notes) = points_from_bytes(&text_of(&["1 2 3", "4 5 6"])).unwrap();
        assert_eq!(plain.points_in_world_m, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        assert!(
            plain.colors_srgb.is_empty() && notes.is_empty(),
            "{notes:?}"
        );
        let fractions =
            "property float nx\nproperty float red\nproperty float green\nproperty double blue\n";
        let file = header("ascii", 1, fractions) + "1 2 3 9 1.0 0.2 7.5\n";
        let (colored, notes) = points_from_bytes(file.as_bytes()).unwrap();
        assert_eq!(
            (colored.colors_srgb, notes.len()),
            (vec![[255, 51, 255]], 0),
            "normals are ignored"
        );
        let incomplete = header(
            "ascii",
            1,
            "property uchar red\nproperty float confidence\n",
        ) + "1 2 3 200 0.5\n1 2 3\n";
        let (gray, notes) = points_from_bytes(incomplete.as_bytes()).unwrap();
        assert!(gray.colors_srgb.is_empty());
        assert_eq!(
            notes,
            [
                "5 bytes after the last row are not used",
                "properties that are not used: red, confidence"
            ]
        );
    }

    #[test]
    fn unusable_points_are_counted_and_damaged_files_are_rejected() {
        let rows = ["nan 0 0", "1 2 3", "0 inf 0", "0 0 -10001", "0 0 10000"];
        let (points, notes) = points_from_bytes(&text_of(&rows)).unwrap();
        assert_eq!(
            points.points_in_world_m,
            [[1.0, 2.0, 3.0], [0.0, 0.0, 10_000.0]]
        );
        assert_eq!(
            notes,
            ["left out 3 of 5 points: their coordinates are not finite or exceed 10000 m"]
        );
        let reason = |file: &[u8]| points_from_bytes(file).unwrap_err();
        assert!(reason(&text_of(&["nan 0 0"])).starts_with("none of 1 points can be used"));
        assert_eq!(reason(&text_of(&[])), "it contains no points");
        assert!(reason(b"solid").contains("no PLY header"));
        let binary = header("binary_little_endian", 2, "").into_bytes();
        assert!(
            reason(&[&binary[..], &[0; 23]].concat())
                .contains("truncated: fewer than 2 rows of \"vertex\"")
        );
        assert!(
            points_from_bytes(header("binary_little_endian", usize::MAX, "").as_bytes()).is_err()
        );

        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("splats.ply");
        ply::write(&path, &synthetic_cloud(3, 0)).unwrap();
        let error = read_points(&path).unwrap_err().to_string();
        assert!(
            error.contains("splats.ply")
                && error.contains("it is a splat model, expected a point cloud"),
            "{error}"
        );
        assert!(matches!(
            read_points(&folder.path().join("none.ply")),
            Err(Error::Read { .. })
        ));
        std::fs::write(&path, text_of(&["1 2 3"])).unwrap();
        assert_eq!(
            read_points(&path).unwrap().0.points_in_world_m,
            [[1.0, 2.0, 3.0]]
        );
    }
}
