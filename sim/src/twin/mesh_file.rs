//! Reads triangles from STL, OBJ and COLLADA files, which are the mesh files of a robot description.
//!
//! Sources of the formats: 3D Systems, "Stereolithography Interface Specification" (1989), and
//! Wavefront, "Advanced Visualizer Manual", appendix B1 (OBJ).

use crate::mesh::{Corner, Mesh};
use nalgebra::{Point3, Vector3};

/// Largest number of triangles of one file. With more triangles, software rendering would take
/// seconds per image.
const MAX_TRIANGLES: usize = 200_000;
/// Sizes of the header of a binary STL file and of each of its triangles, bytes.
const STL_HEADER_BYTES: usize = 84;
const STL_TRIANGLE_BYTES: usize = 50;

/// Three corners, counterclockwise from outside.
type Triangle = [Point3<f64>; 3];

/// Reads a mesh and scales it. Its triangles are flat.
///
/// # Errors
///
/// Fails if the file has another format, or no valid triangles. The error is the reason as one
/// sentence.
pub(crate) fn read(file: &str, bytes: &[u8], scale: [f64; 3]) -> Result<Mesh, String> {
    let extension = file.rsplit('.').next().unwrap_or_default();
    let triangles = match extension.to_ascii_lowercase().as_str() {
        "stl" => stl(bytes)?,
        "obj" => obj(&String::from_utf8_lossy(bytes))?,
        "dae" => collada(&String::from_utf8_lossy(bytes))?,
        other => {
            return Err(format!(
                "the simulator cannot read .{other} files, convert it to .stl, .dae or .obj"
            ));
        }
    };
    if triangles.len() > MAX_TRIANGLES {
        return Err(format!(
            "it has {} triangles, the maximum is {MAX_TRIANGLES}",
            triangles.len()
        ));
    }
    let is_mirrored = scale.iter().product::<f64>() < 0.0;
    let mut mesh = Mesh::default();
    let mut n_drawn = 0;
    for triangle in &triangles {
        let mut corners =
            triangle.map(|point| Point3::from(point.coords.component_mul(&Vector3::from(scale))));
        // A mirrored triangle would face inward.
        if is_mirrored {
            corners.swap(1, 2);
        }
        n_drawn += usize::from(add(&mut mesh, &corners));
    }
    if n_drawn == 0 {
        return Err("it has no triangles with an area".to_owned());
    }
    Ok(mesh)
}

/// Adds a flat triangle. Returns false for a triangle without an area, because it has no normal.
fn add(mesh: &mut Mesh, corners: &Triangle) -> bool {
    let [a, b, c] = corners;
    let normal = (b - a).cross(&(c - a));
    // The comparison is false for NaN.
    if !(normal.norm() > 1e-14 && normal.norm().is_finite()) {
        return false;
    }
    let ixs = corners.map(|point_m| {
        mesh.push(Corner {
            point_m,
            normal: normal.normalize(),
            texcoord: [0.0; 2],
        })
    });
    mesh.triangle(ixs);
    true
}

fn stl(bytes: &[u8]) -> Result<Vec<Triangle>, String> {
    let n_binary = bytes
        .get(STL_HEADER_BYTES - 4..STL_HEADER_BYTES)
        .and_then(|count| count.try_into().ok())
        .map(u32::from_le_bytes)
        .and_then(|count| usize::try_from(count).ok());
    // Many binary files start with the word `solid` of text files, so the kind of file is
    // determined from the size.
    if let Some(n_triangles) = n_binary
        && n_triangles.checked_mul(STL_TRIANGLE_BYTES) == Some(bytes.len() - STL_HEADER_BYTES)
    {
        return Ok(bytes[STL_HEADER_BYTES..]
            .chunks_exact(STL_TRIANGLE_BYTES)
            .map(binary_triangle)
            .collect());
    }
    if bytes.trim_ascii_start().starts_with(b"solid") {
        return stl_text(&String::from_utf8_lossy(bytes));
    }
    Err("it is neither a binary nor a text STL file".to_owned())
}

/// A triangle of a binary STL file, which consists of a normal, three corners, and two unused
/// bytes.
fn binary_triangle(bytes: &[u8]) -> Triangle {
    let number = |ix: usize| {
        let start = 4 * ix;
        let bytes = [
            bytes[start],
            bytes[start + 1],
            bytes[start + 2],
            bytes[start + 3],
        ];
        f64::from(f32::from_le_bytes(bytes))
    };
    [3, 6, 9].map(|at| Point3::new(number(at), number(at + 1), number(at + 2)))
}

fn stl_text(text: &str) -> Result<Vec<Triangle>, String> {
    let mut points = Vec::new();
    for line in text.lines() {
        if let Some(numbers) = line.trim_start().strip_prefix("vertex") {
            points.push(point(numbers)?);
        }
    }
    Ok(points
        .chunks_exact(3)
        .map(|corners| [corners[0], corners[1], corners[2]])
        .collect())
}

fn obj(text: &str) -> Result<Vec<Triangle>, String> {
    let mut points = Vec::new();
    let mut triangles = Vec::new();
    for line in text.lines() {
        let line = line.trim_start();
        if let Some(numbers) = line.strip_prefix("v ") {
            points.push(point(numbers)?);
        } else if let Some(corners) = line.strip_prefix("f ") {
            let corners = corners
                .split_whitespace()
                .map(|corner| obj_corner(corner, &points))
                .collect::<Result<Vec<_>, _>>()?;
            // Polygons are split into a fan, which is correct for convex polygons.
            for pair in corners.get(1..).unwrap_or_default().windows(2) {
                triangles.push([corners[0], pair[0], pair[1]]);
            }
            if triangles.len() > MAX_TRIANGLES {
                break;
            }
        }
    }
    Ok(triangles)
}

fn collada(text: &str) -> Result<Vec<Triangle>, String> {
    let triangles = kinematics::collada::triangles(text).map_err(|error| error.to_string())?;
    let points = triangles
        .into_iter()
        .map(|corners| corners.map(Point3::from));
    Ok(points.collect())
}

/// The point of a corner such as `3`, `3/1` or `-1//2`. Indices start at 1. Negative indices count
/// from the last point.
fn obj_corner(corner: &str, points: &[Point3<f64>]) -> Result<Point3<f64>, String> {
    let index = corner.split('/').next().unwrap_or_default();
    let position = index.parse::<i64>().ok().and_then(|index| {
        let from_start = if index < 0 {
            index.checked_add(i64::try_from(points.len()).ok()?)?
        } else {
            index - 1
        };
        points.get(usize::try_from(from_start).ok()?).copied()
    });
    position.ok_or_else(|| format!("a face has the corner {corner:?}, which is not a point"))
}

/// The first three numbers of a line.
fn point(numbers: &str) -> Result<Point3<f64>, String> {
    let mut numbers = numbers
        .split_whitespace()
        .map(|number| number.parse::<f64>().ok().filter(|value| value.is_finite()));
    match [numbers.next(), numbers.next(), numbers.next()] {
        [Some(Some(x)), Some(Some(y)), Some(Some(z))] => Ok(Point3::new(x, y, z)),
        _ => Err("a point does not have three finite numbers".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts of points and faces in the bytes for MuJoCo.
    fn counts(mesh: &Mesh) -> [i32; 2] {
        let bytes = mesh.to_msh();
        [0, 12].map(|at: usize| i32::from_le_bytes(bytes[at..at + 4].try_into().expect("four")))
    }

    fn binary_stl(triangles: &[[f32; 9]]) -> Vec<u8> {
        let mut bytes = b"solid but binary".to_vec();
        bytes.resize(80, 0);
        bytes.extend(u32::try_from(triangles.len()).expect("few").to_le_bytes());
        for triangle in triangles {
            bytes.extend([0; 12]);
            bytes.extend(triangle.iter().flat_map(|number| number.to_le_bytes()));
            bytes.extend([0; 2]);
        }
        bytes
    }

    const CORNER: [f32; 9] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];

    #[test]
    fn binary_text_and_obj_files_are_read() {
        let binary = binary_stl(&[CORNER, [0.0; 9]]);
        let text = "solid a\n facet normal 0 0 1\n outer loop\n vertex 0 0 0\n vertex 1 0 0\n vertex 0 1 0\n\
                    endloop\nendfacet\nendsolid";
        let obj = "# square\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/1 2/2 3/3 -1//4\n";
        let read = |file: &str, bytes: &[u8]| read(file, bytes, [1.0; 3]).expect("a mesh");
        // The second triangle has no area.
        assert_eq!(counts(&read("a.STL", &binary)), [3, 1]);
        assert_eq!(counts(&read("a.stl", text.as_bytes())), [3, 1]);
        assert_eq!(counts(&read("a.obj", obj.as_bytes())), [6, 2]);
    }

    #[test]
    fn mirrored_meshes_still_face_outward() {
        let normal = |scale: [f64; 3]| {
            let mesh = read("a.stl", &binary_stl(&[CORNER]), scale).expect("a mesh");
            let bytes = mesh.to_msh();
            // The normals follow the four counts and three points.
            let at = 16 + 3 * 12 + 8;
            f32::from_le_bytes(bytes[at..at + 4].try_into().expect("four"))
        };
        assert_eq!(normal([1.0; 3]), 1.0);
        // The triangle lies in the plane z = 0 and is mirrored along x, so it faces +z as before.
        assert_eq!(normal([-1.0, 1.0, 1.0]), 1.0);
    }

    #[test]
    fn damaged_files_are_refused_with_a_reason() {
        let mut truncated = binary_stl(&[CORNER]);
        truncated.pop();
        for (file, bytes, reason) in [
            ("a.stl", &truncated[..], "no triangles"),
            ("a.stl", &b"hello"[..], "neither"),
            ("a.obj", &b"v 0 0\n"[..], "three finite numbers"),
            ("a.obj", &b"v 0 0 0\nf 1 2 3\n"[..], "not a point"),
            ("a.dae", &b"<COLLADA/>"[..], "no triangles"),
            ("a.dae", &b"<robot/>"[..], "expected a <COLLADA>"),
            ("a.glb", &b"glTF"[..], ".glb"),
        ] {
            let error = read(file, bytes, [1.0; 3]).expect_err("damaged");
            assert!(error.contains(reason), "{file}: {error}");
        }
    }
}
