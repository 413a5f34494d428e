//! Reads the triangles of mesh files, which bound the parts of a robot.
//!
//! Sources of the formats: 3D Systems, "Stereolithography Interface Specification" (1989), and
//! Wavefront, "Advanced Visualizer Manual", appendix B1 (OBJ).

use crate::config::UrdfFolder;
use files::Budget;
use kinematics::collada;

/// Sizes of the header of a binary STL file and of each of its triangles, bytes.
const STL_HEADER_BYTES: usize = 84;
const STL_TRIANGLE_BYTES: usize = 50;
/// Sizes of a number and of the normal before the corners of a triangle, bytes.
const NUMBER_BYTES: usize = 4;
const NORMAL_BYTES: usize = 3 * NUMBER_BYTES;

pub use kinematics::collada::Triangle;

/// Triangles of a mesh file of a URDF in the frame of the mesh, meters. Faces with more corners are
/// divided into triangles. A vertex of an OBJ file without faces is a triangle without area.
///
/// * `budget`: limits the size of the file.
///
/// # Errors
///
/// Why the file cannot be read, in one sentence.
pub fn mesh_triangles(
    file: &str,
    urdf_folder: &UrdfFolder,
    budget: Budget,
) -> Result<Vec<Triangle>, String> {
    let bytes = urdf_folder.read_mesh(file, budget)?;
    let extension = file.rsplit('.').next().unwrap_or_default();
    let triangles = match extension.to_ascii_lowercase().as_str() {
        "stl" => stl(&bytes)?,
        "obj" => obj(&String::from_utf8_lossy(&bytes))?,
        "dae" => collada::triangles(&String::from_utf8_lossy(&bytes))
            .map_err(|error| error.to_string())?,
        other => {
            return Err(format!(
                ".{other} files cannot be read, convert it to .stl, .dae or .obj"
            ));
        }
    };
    if triangles.is_empty() {
        return Err("it has no vertices".to_owned());
    }
    Ok(triangles)
}

fn stl(bytes: &[u8]) -> Result<Vec<Triangle>, String> {
    let n_triangles = bytes
        .get(STL_HEADER_BYTES - NUMBER_BYTES..STL_HEADER_BYTES)
        .and_then(|count| count.try_into().ok())
        .map(u32::from_le_bytes)
        .and_then(|count| usize::try_from(count).ok());
    // Many binary files start with the word `solid` of text files, so the size decides.
    if let Some(n_triangles) = n_triangles
        && n_triangles.checked_mul(STL_TRIANGLE_BYTES) == Some(bytes.len() - STL_HEADER_BYTES)
    {
        let triangles = bytes[STL_HEADER_BYTES..].chunks_exact(STL_TRIANGLE_BYTES);
        return Ok(triangles.map(binary_corners).collect());
    }
    if bytes.trim_ascii_start().starts_with(b"solid") {
        let corners = points(&String::from_utf8_lossy(bytes), "vertex ")?;
        return Ok(corners.as_chunks::<3>().0.to_vec());
    }
    Err("it is neither a binary nor a text STL file".to_owned())
}

/// The corners of a triangle of a binary STL file, after its normal.
fn binary_corners(triangle: &[u8]) -> Triangle {
    let number = |ix: usize| {
        let start = NORMAL_BYTES + NUMBER_BYTES * ix;
        let bytes: [u8; NUMBER_BYTES] = std::array::from_fn(|at| triangle[start + at]);
        f64::from(f32::from_le_bytes(bytes))
    };
    std::array::from_fn(|corner| std::array::from_fn(|axis| number(3 * corner + axis)))
}

/// The triangles of an OBJ file.
fn obj(text: &str) -> Result<Vec<Triangle>, String> {
    let vertices = points(text, "v ")?;
    let mut triangles = Vec::new();
    for (ix, line) in text.lines().enumerate() {
        let Some(corners) = line.trim_start().strip_prefix("f ") else {
            continue;
        };
        let corners: Option<Vec<[f64; 3]>> = corners
            .split_whitespace()
            .map(|corner| face_corner(corner, &vertices))
            .collect();
        let Some(corners) = corners else {
            return Err(format!(
                "line {} names a vertex that does not exist",
                ix + 1
            ));
        };
        // Faces are flat and convex, so they can be divided into triangles at their first corner.
        let pairs = corners.windows(2).skip(1);
        triangles.extend(pairs.map(|pair| [corners[0], pair[0], pair[1]]));
    }
    if triangles.is_empty() {
        triangles.extend(vertices.iter().map(|vertex| [*vertex; 3]));
    }
    Ok(triangles)
}

/// The vertex of a corner such as `7/1/3` (vertex 7) or `-1` (the last vertex).
fn face_corner(corner: &str, vertices: &[[f64; 3]]) -> Option<[f64; 3]> {
    let number: i64 = corner.split('/').next()?.parse().ok()?;
    let n_vertices = i64::try_from(vertices.len()).ok()?;
    let ix = if number < 0 {
        n_vertices + number
    } else {
        number - 1
    };
    vertices.get(usize::try_from(ix).ok()?).copied()
}

/// The points on the lines of a text file that start with a keyword.
fn points(text: &str, keyword: &str) -> Result<Vec<[f64; 3]>, String> {
    let lines = text.lines().enumerate();
    let points = lines.filter_map(|(ix, line)| {
        let numbers = line.trim_start().strip_prefix(keyword)?;
        Some(point(numbers).ok_or_else(|| format!("line {} has no point", ix + 1)))
    });
    points.collect()
}

fn point(numbers: &str) -> Option<[f64; 3]> {
    let mut numbers = numbers.split_whitespace();
    let mut next = || -> Option<f64> {
        let number: f64 = numbers.next()?.parse().ok()?;
        number.is_finite().then_some(number)
    };
    Some([next()?, next()?, next()?])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangles(name: &str, contents: &[u8]) -> Result<Vec<Triangle>, String> {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join(name), contents).expect("written");
        mesh_triangles(name, &UrdfFolder::at(folder.path()), Budget::MESH)
    }

    #[test]
    fn triangles_of_all_formats_are_read() {
        let mut binary = b"solid, but binary".to_vec();
        binary.resize(STL_HEADER_BYTES - NUMBER_BYTES, 0);
        binary.extend(1_u32.to_le_bytes());
        let numbers = [
            0.0, 0.0, 1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.5_f32,
        ];
        binary.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        binary.extend([0, 0]);
        let expected = vec![[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.5]]];
        assert_eq!(triangles("a.stl", &binary), Ok(expected.clone()));
        let stl = "solid\n facet normal 0 0 1\n outer loop\n vertex 1 2 3\n vertex 4 5 6\n\
                   vertex 7 8 9.5\n endloop\n endfacet\nendsolid\n";
        assert_eq!(triangles("a.STL", stl.as_bytes()), Ok(expected.clone()));
        let obj = "# a mesh\nvn 0 0 1\nv 1 2 3\nv 4 5 6\nv 7 8 9.5\nf 1 2 3\n";
        assert_eq!(triangles("a.obj", obj.as_bytes()), Ok(expected));
        let square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/1/1 2//1 3 -1\n";
        let halves = triangles("a.obj", square.as_bytes()).expect("a square");
        assert_eq!(halves[1], [[0.0; 3], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]);
        assert_eq!(halves.len(), 2);
        let cloud = triangles("a.obj", b"v 1 2 3\nv 4 5 6\n").expect("vertices");
        assert_eq!(cloud, [[[1.0, 2.0, 3.0]; 3], [[4.0, 5.0, 6.0]; 3]]);
    }

    #[test]
    fn broken_files_are_refused_with_a_reason() {
        for (name, contents, words) in [
            ("a.stl", "short", "neither a binary nor a text"),
            ("a.stl", "solid\n vertex 1 2\n", "line 2 has no point"),
            ("a.obj", "v 1 2 inf\n", "line 1 has no point"),
            ("a.obj", "v 1 2 3\nf 1 2 1\n", "line 2 names a vertex"),
            ("a.obj", "# nothing\n", "no vertices"),
            ("a.dae", "<COLLADA/>", "no vertices"),
            ("a.dae", "<robot/>", "expected a <COLLADA>"),
            ("a.glb", "glTF", "convert it to .stl"),
        ] {
            let error = triangles(name, contents.as_bytes()).expect_err(name);
            assert!(error.contains(words), "{name}: {error}");
        }
        let nowhere = UrdfFolder::at(std::path::Path::new("/nowhere"));
        let missing = mesh_triangles("missing.stl", &nowhere, Budget::MESH).expect_err("missing");
        assert!(missing.contains("no such file"), "{missing}");
    }
}
