//! Reads the triangles of COLLADA files (`.dae`), in which most public robot descriptions store
//! their visual shapes.
//!
//! Source of the format: Khronos, "COLLADA: Digital Asset Schema Release 1.4.1" (2008), chapter 5.
//! Materials, normals, lines, curves and skins are not read. Like `RViz` and the page, this reader
//! ignores `<up_axis>`, because robot descriptions are written for programs that ignore it.

use crate::Error;
use crate::xml_limits::{self, MAX_NODES};
use nalgebra::{Matrix4, Point3, Rotation3, Unit, Vector3};
use roxmltree::{Document, Node, ParsingOptions};
use std::collections::BTreeMap;
use std::rc::Rc;

/// Maximum size of a file, bytes, as for all mesh files of robots.
pub const MAX_BYTES: usize = 64 << 20;
/// Maximum number of triangles. Nodes may use the same geometry many times, so that a small file
/// could have any number.
const MAX_TRIANGLES: usize = 4_000_000;
/// Maximum number of nodes in the scene. Nodes may contain other nodes many times.
const MAX_SCENE_NODES: usize = 100_000;

/// The corners of a triangle, meters.
pub type Triangle = [[f64; 3]; 3];

/// The triangles of a file in the frame of the mesh, meters. Faces with more corners are divided
/// into triangles.
///
/// # Errors
///
/// If the text is not COLLADA, refers to data that it lacks, or exceeds a limit.
pub fn triangles(xml: &str) -> Result<Vec<Triangle>, Error> {
    read(xml).map_err(|why| Error::Collada { why })
}

fn read(xml: &str) -> Result<Vec<Triangle>, String> {
    xml_limits::check(xml, MAX_BYTES)?;
    let options = ParsingOptions {
        nodes_limit: MAX_NODES,
        ..ParsingOptions::default()
    };
    let document = Document::parse_with_options(xml, options).map_err(|error| error.to_string())?;
    let root = document.root_element();
    if root.tag_name().name() != "COLLADA" {
        let name = root.tag_name().name();
        return Err(format!("it describes a <{name}>, expected a <COLLADA>"));
    }
    let file = File::new(&document);
    let mut triangles = Vec::new();
    for placed in file.placed_geometries()? {
        let corner = |point: [f64; 3]| {
            let file_from_geometry = &placed.file_from_geometry;
            let point = file_from_geometry.transform_point(&Point3::from(point));
            (point.coords * file.meters_per_unit).into()
        };
        triangles.extend(placed.triangles.iter().map(|corners| corners.map(corner)));
    }
    let is_finite = |triangle: &Triangle| triangle.as_flattened().iter().all(|x| x.is_finite());
    if !triangles.iter().all(is_finite) {
        return Err("a corner of a triangle is not finite".to_owned());
    }
    Ok(triangles)
}

/// The elements of a file.
struct File<'a> {
    root: Node<'a, 'a>,
    by_id: BTreeMap<&'a str, Node<'a, 'a>>,
    meters_per_unit: f64,
}

/// A geometry at a place in the scene.
struct PlacedGeometry {
    file_from_geometry: Matrix4<f64>,
    triangles: Rc<[Triangle]>,
}

impl<'a> File<'a> {
    fn new(document: &'a Document<'a>) -> Self {
        let root = document.root_element();
        let elements = document.descendants().filter(Node::is_element);
        let by_id = elements.filter_map(|element| Some((element.attribute("id")?, element)));
        let unit = child(root, "asset").and_then(|asset| child(asset, "unit"));
        let meters_per_unit = unit
            .and_then(|unit| unit.attribute("meter")?.trim().parse().ok())
            .filter(|meters: &f64| meters.is_finite() && *meters > 0.0);
        Self {
            root,
            by_id: by_id.collect(),
            meters_per_unit: meters_per_unit.unwrap_or(1.0),
        }
    }

    /// The element that a reference such as `#link0` names.
    fn referenced(&self, reference: &str) -> Result<Node<'a, 'a>, String> {
        let found = reference
            .trim()
            .strip_prefix('#')
            .and_then(|id| self.by_id.get(id));
        found
            .copied()
            .ok_or_else(|| format!("it refers to {reference:?}, which it does not contain"))
    }

    /// The geometries of the scene. Without a scene, all geometries at the origin.
    fn placed_geometries(&self) -> Result<Vec<PlacedGeometry>, String> {
        let mut scene = Scene {
            file: self,
            known: BTreeMap::new(),
            placed: Vec::new(),
            n_triangles: 0,
        };
        let roots = self.scene_nodes()?;
        if roots.is_empty() {
            for geometry in named(self.root.descendants(), "geometry") {
                scene.place(geometry, Matrix4::identity())?;
            }
            return Ok(scene.placed);
        }
        // The nodes are visited without recursion, so that a deep file cannot overflow the stack.
        let mut waiting: Vec<(Node<'_, '_>, Matrix4<f64>)> = roots
            .into_iter()
            .rev()
            .map(|node| (node, Matrix4::identity()))
            .collect();
        let mut n_visited = 0;
        while let Some((node, file_from_parent)) = waiting.pop() {
            n_visited += 1;
            if n_visited > MAX_SCENE_NODES {
                return Err(format!("its scene has more than {MAX_SCENE_NODES} nodes"));
            }
            let file_from_node = file_from_parent * transform_of(node)?;
            for element in node.children().filter(Node::is_element) {
                match element.tag_name().name() {
                    "node" => waiting.push((element, file_from_node)),
                    "instance_node" => waiting.push((self.instance(element)?, file_from_node)),
                    "instance_geometry" => {
                        scene.place(self.instance(element)?, file_from_node)?;
                    }
                    _ => {}
                }
            }
        }
        Ok(scene.placed)
    }

    /// The outermost nodes of the scene.
    fn scene_nodes(&self) -> Result<Vec<Node<'a, 'a>>, String> {
        let scene =
            child(self.root, "scene").and_then(|scene| child(scene, "instance_visual_scene"));
        let scenes = match scene {
            Some(instance) => vec![self.instance(instance)?],
            None => named(self.root.descendants(), "visual_scene").collect(),
        };
        let nodes = scenes.iter().flat_map(Node::children);
        Ok(named(nodes, "node").collect())
    }

    fn instance(&self, element: Node<'a, 'a>) -> Result<Node<'a, 'a>, String> {
        self.referenced(element.attribute("url").unwrap_or_default())
    }

    /// The triangles of a geometry, in its own units.
    fn triangles_of(&self, geometry: Node<'a, 'a>) -> Result<Vec<Triangle>, String> {
        let mut triangles = Vec::new();
        let Some(mesh) = child(geometry, "mesh") else {
            return Ok(triangles);
        };
        for primitive in mesh.children().filter(Node::is_element) {
            let add_face: fn(&[[f64; 3]], &mut Vec<Triangle>) = match primitive.tag_name().name() {
                "triangles" | "polylist" | "polygons" | "trifans" => add_fan,
                "tristrips" => add_strip,
                _ => continue,
            };
            for face in self.faces_of(primitive)? {
                add_face(&face, &mut triangles);
            }
        }
        Ok(triangles)
    }

    /// The corners of each face of a primitive element.
    fn faces_of(&self, primitive: Node<'a, 'a>) -> Result<Vec<Vec<[f64; 3]>>, String> {
        let inputs: Vec<_> = named(primitive.children(), "input").collect();
        let offset_of = |input: &Node<'_, '_>| {
            let offset = input.attribute("offset").unwrap_or("0").trim();
            offset.parse::<usize>().ok().filter(|offset| *offset < 1000)
        };
        let offsets: Option<Vec<usize>> = inputs.iter().map(offset_of).collect();
        let offsets = offsets.ok_or_else(|| at(primitive, "an offset is not a small number"))?;
        let is_position = |input: &&Node<'_, '_>| {
            matches!(input.attribute("semantic"), Some("VERTEX" | "POSITION"))
        };
        let Some(ix) = inputs.iter().position(|input| is_position(&input)) else {
            return Ok(Vec::new());
        };
        let points = self.points_of(inputs[ix])?;
        let n_per_corner = 1 + offsets.iter().copied().max().unwrap_or(0);
        let corners = |list: Node<'_, '_>| -> Result<Vec<[f64; 3]>, String> {
            let ixs: Vec<usize> = numbers(list)?;
            let of_corners = ixs.chunks_exact(n_per_corner);
            of_corners
                .map(|corner| points.get(corner[offsets[ix]]).copied())
                .collect::<Option<_>>()
                .ok_or_else(|| at(list, "it names a vertex that does not exist"))
        };
        let lists = primitive
            .descendants()
            .filter(|node| node.tag_name().name() == "p");
        let mut faces = Vec::new();
        for list in lists {
            let corners = corners(list)?;
            match primitive.tag_name().name() {
                "triangles" => faces.extend(corners.chunks_exact(3).map(<[_]>::to_vec)),
                "polylist" => faces.extend(divided(primitive, &corners)?),
                _ => faces.push(corners),
            }
        }
        Ok(faces)
    }

    /// The points to which an input refers, directly or through `<vertices>`.
    fn points_of(&self, input: Node<'a, 'a>) -> Result<Vec<[f64; 3]>, String> {
        let mut source = self.referenced(input.attribute("source").unwrap_or_default())?;
        if source.tag_name().name() == "vertices" {
            let position = named(source.children(), "input")
                .find(|input| input.attribute("semantic") == Some("POSITION"))
                .ok_or_else(|| at(source, "it has no input with the semantic POSITION"))?;
            source = self.referenced(position.attribute("source").unwrap_or_default())?;
        }
        let accessor = child(source, "technique_common")
            .and_then(|technique| child(technique, "accessor"))
            .ok_or_else(|| at(source, "it has no <accessor>"))?;
        let array = self.referenced(accessor.attribute("source").unwrap_or_default())?;
        let number = |name: &str, default: usize| match accessor.attribute(name) {
            Some(text) => text.trim().parse().ok(),
            None => Some(default),
        };
        let (Some(offset), Some(stride @ 3..)) = (number("offset", 0), number("stride", 1)) else {
            return Err(at(accessor, "its points do not have three coordinates"));
        };
        let values: Vec<f64> = numbers(array)?;
        let values = values.get(offset..).unwrap_or_default();
        let points = values.chunks(stride).filter(|point| point.len() >= 3);
        Ok(points.map(|point| [point[0], point[1], point[2]]).collect())
    }
}

/// The geometries that were found in a scene.
struct Scene<'a> {
    file: &'a File<'a>,
    /// Triangles by the position of the geometry in the file, because nodes often share geometries.
    known: BTreeMap<usize, Rc<[Triangle]>>,
    placed: Vec<PlacedGeometry>,
    n_triangles: usize,
}

impl<'a> Scene<'a> {
    fn place(
        &mut self,
        geometry: Node<'a, 'a>,
        file_from_geometry: Matrix4<f64>,
    ) -> Result<(), String> {
        let position = geometry.range().start;
        let triangles = match self.known.get(&position) {
            Some(known) => known.clone(),
            None => self.file.triangles_of(geometry)?.into(),
        };
        self.known.insert(position, triangles.clone());
        self.n_triangles = self.n_triangles.saturating_add(triangles.len());
        if self.n_triangles > MAX_TRIANGLES {
            return Err(format!("it has more than {MAX_TRIANGLES} triangles"));
        }
        self.placed.push(PlacedGeometry {
            file_from_geometry,
            triangles,
        });
        Ok(())
    }
}

/// The transform of a node to its parent: the product of its transform elements in their order.
fn transform_of(node: Node<'_, '_>) -> Result<Matrix4<f64>, String> {
    let mut product = Matrix4::identity();
    for element in node.children().filter(Node::is_element) {
        let name = element.tag_name().name();
        let n_expected = match name {
            "matrix" => 16,
            "rotate" => 4,
            "translate" | "scale" => 3,
            "skew" | "lookat" => {
                return Err(at(element, "this kind of transform cannot be read"));
            }
            _ => continue,
        };
        let values: Vec<f64> = numbers(element)?;
        if values.len() != n_expected {
            let n_found = values.len();
            return Err(at(
                element,
                &format!("it has {n_found} numbers, expected {n_expected}"),
            ));
        }
        product *= match name {
            "matrix" => Matrix4::from_row_slice(&values),
            "translate" => Matrix4::new_translation(&Vector3::from_column_slice(&values)),
            "scale" => Matrix4::new_nonuniform_scaling(&Vector3::from_column_slice(&values)),
            _ => rotation(&values),
        };
    }
    Ok(product)
}

/// The rotation about an axis (the first three values) by an angle (the last one, degrees).
fn rotation(values: &[f64]) -> Matrix4<f64> {
    let axis = Unit::try_new(Vector3::from_column_slice(&values[..3]), f64::MIN_POSITIVE);
    axis.map_or_else(Matrix4::identity, |axis| {
        Rotation3::from_axis_angle(&axis, values[3].to_radians()).to_homogeneous()
    })
}

/// Adds a triangle fan. Convex polygons are fans, too: all triangles share the first corner.
fn add_fan(corners: &[[f64; 3]], triangles: &mut Vec<Triangle>) {
    let pairs = corners.windows(2).skip(1);
    triangles.extend(pairs.map(|pair| [corners[0], pair[0], pair[1]]));
}

/// Adds a strip, in which every second triangle has the opposite order.
fn add_strip(corners: &[[f64; 3]], triangles: &mut Vec<Triangle>) {
    for (ix, corners) in corners.windows(3).enumerate() {
        let [first, second] = if ix % 2 == 0 { [0, 1] } else { [1, 0] };
        triangles.push([corners[first], corners[second], corners[2]]);
    }
}

/// The corners of a `<polylist>`, divided by its list of the numbers of corners.
fn divided(polylist: Node<'_, '_>, corners: &[[f64; 3]]) -> Result<Vec<Vec<[f64; 3]>>, String> {
    let counts: Vec<usize> = child(polylist, "vcount").map_or(Ok(Vec::new()), numbers)?;
    let mut rest = corners;
    let mut faces = Vec::new();
    for n in counts {
        let (face, after) = rest
            .split_at_checked(n)
            .ok_or_else(|| at(polylist, "it has fewer corners than <vcount> says"))?;
        rest = after;
        faces.push(face.to_vec());
    }
    Ok(faces)
}

/// The numbers in the text of an element.
fn numbers<T: std::str::FromStr>(element: Node<'_, '_>) -> Result<Vec<T>, String> {
    let words = element.text().unwrap_or_default().split_ascii_whitespace();
    words
        .map(|word| word.parse().ok())
        .collect::<Option<_>>()
        .ok_or_else(|| at(element, "it contains an invalid number"))
}

/// The first child element with this name.
fn child<'a>(parent: Node<'a, 'a>, name: &str) -> Option<Node<'a, 'a>> {
    parent
        .children()
        .find(|node| node.tag_name().name() == name)
}

/// The elements with this name.
fn named<'a, 'n>(
    nodes: impl Iterator<Item = Node<'a, 'a>> + 'n,
    name: &'n str,
) -> impl Iterator<Item = Node<'a, 'a>> + 'n {
    nodes.filter(move |node| node.is_element() && node.tag_name().name() == name)
}

/// A problem with an element, with its place.
fn at(element: Node<'_, '_>, why: &str) -> String {
    let line = element.document().text_pos_at(element.range().start).row;
    let name = element.tag_name().name();
    format!("line {line}: <{name}>: {why}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file with a square of four points, the primitives inside its mesh, and a scene.
    fn file(unit: &str, primitives: &str, scene: &str) -> String {
        format!(
            r##"<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset>{unit}<up_axis>Y_UP</up_axis></asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="s"><float_array id="a" count="12">0 0 0  1 0 0  1 1 0  0 1 0</float_array>
      <technique_common><accessor source="#a" count="4" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <source id="n"><float_array id="na" count="3">0 0 1</float_array></source>
    <vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
    {primitives}
  </mesh></geometry></library_geometries>
  {scene}
</COLLADA>"##
        )
    }

    const TRIANGLES: &str = r##"<triangles count="2" material="m">
        <input semantic="NORMAL" source="#n" offset="1"/><input semantic="VERTEX" source="#v" offset="0"/>
        <p>0 0 1 0 2 0 0 0 2 0 3 0</p></triangles>"##;

    fn scene(nodes: &str) -> String {
        format!(
            r##"<library_visual_scenes><visual_scene id="vs">{nodes}</visual_scene></library_visual_scenes>
                <scene><instance_visual_scene url="#vs"/></scene>"##
        )
    }

    fn is_close(one: &[Triangle], other: &[Triangle]) -> bool {
        let flat = |triangles: &[Triangle]| triangles.as_flattened().as_flattened().to_vec();
        one.len() == other.len()
            && flat(one)
                .iter()
                .zip(flat(other))
                .all(|(one, other)| (one - other).abs() < 1e-9)
    }

    const SQUARE: [Triangle; 2] = [
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]],
        [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]],
    ];

    #[test]
    fn all_primitives_give_the_same_triangles() {
        let input = r##"<input semantic="VERTEX" source="#v" offset="0"/>"##;
        for primitives in [
            TRIANGLES.to_owned(),
            format!("<polylist count=\"1\">{input}<vcount>4</vcount><p>0 1 2 3</p></polylist>"),
            format!("<polylist count=\"2\">{input}<vcount>3 3</vcount><p>0 1 2 0 2 3</p></polylist>"),
            format!("<polygons count=\"1\">{input}<p>0 1 2 3</p></polygons>"),
            format!("<trifans count=\"1\">{input}<p>0 1 2 3</p></trifans>"),
            r##"<triangles><input semantic="POSITION" source="#s"/><p>0 1 2 0 2 3</p></triangles>"##
                .to_owned(),
        ] {
            let found = triangles(&file("", &primitives, "")).expect("a file");
            assert!(is_close(&found, &SQUARE), "{primitives}: {found:?}");
        }
        let strip = format!("<tristrips count=\"1\">{input}<p>0 1 3 2</p></tristrips>");
        let [a, b, c, d] = [SQUARE[0][0], SQUARE[0][1], SQUARE[0][2], SQUARE[1][2]];
        let found = triangles(&file("", &strip, "")).expect("a file");
        assert!(is_close(&found, &[[a, b, d], [d, b, c]]), "{found:?}");
        let lines = format!("<lines count=\"1\">{input}<p>0 1</p></lines>");
        assert_eq!(triangles(&file("", &lines, "")), Ok(Vec::new()));
    }

    #[test]
    fn units_and_transforms_of_nodes_apply() {
        let inch = "<unit name=\"inch\" meter=\"0.0254\"/>";
        let nodes = r##"<node><translate>0 0 10</translate><rotate>0 0 1 90</rotate>
            <node><scale>2 2 2</scale><instance_geometry url="#g"/></node></node>"##;
        let found = triangles(&file(inch, TRIANGLES, &scene(nodes))).expect("a file");
        let expected = SQUARE.map(|triangle| {
            triangle.map(|[x, y, _]| [-2.0 * y, 2.0 * x, 10.0].map(|along| 0.0254 * along))
        });
        assert!(is_close(&found, &expected), "{found:?}");
        let matrix = r##"<node><matrix>0 -2 0 0  2 0 0 0  0 0 2 10  0 0 0 1</matrix>
            <instance_geometry url="#g"/></node>"##;
        let found = triangles(&file(inch, TRIANGLES, &scene(matrix))).expect("a file");
        assert!(is_close(&found, &expected), "{found:?}");
        // A node that another one uses twice, and a geometry that no node uses.
        let shared = r##"<node><instance_node url="#part"/></node>
            <node><translate>5 0 0</translate><instance_node url="#part"/></node>"##;
        let library = r##"<library_nodes><node id="part"><instance_geometry url="#g"/></node></library_nodes>"##;
        let text = file("", TRIANGLES, &format!("{library}{}", scene(shared)));
        let found = triangles(&text).expect("a file");
        assert!(is_close(&found[..2], &SQUARE) || is_close(&found[2..], &SQUARE));
        assert_eq!(found.len(), 4);
        assert!(
            triangles(&file("", TRIANGLES, &scene("<node/>")))
                .expect("a file")
                .is_empty()
        );
    }

    #[test]
    fn broken_files_are_refused_with_a_reason() {
        let with = |from: &str, to: &str| {
            let whole = file(
                "",
                TRIANGLES,
                &scene("<node><instance_geometry url=\"#g\"/></node>"),
            );
            assert!(whole.contains(from), "{from}");
            triangles(&whole.replacen(from, to, 1)).map_err(|error| error.to_string())
        };
        for (from, to, words) in [
            ("</COLLADA>", "", "never closed"),
            ("<COLLADA ", "<!DOCTYPE x><COLLADA ", "DTD"),
            ("url=\"#g\"", "url=\"#h\"", "refers to \"#h\""),
            (
                "0 0 1 0 2 0",
                "0 0 1 0 9 0",
                "line 13: <p>: it names a vertex",
            ),
            ("0 0 1 0 2 0", "0 0 -1 0 2 0", "an invalid number"),
            ("0 1 0</float_array>", "0 1 inf</float_array>", "not finite"),
            ("stride=\"3\"", "stride=\"2\"", "three coordinates"),
            ("offset=\"1\"", "offset=\"x\"", "not a small number"),
            (
                "<node>",
                "<node><matrix>1 2</matrix>",
                "has 2 numbers, expected 16",
            ),
            ("<node>", "<node><lookat/>", "<lookat>: this kind"),
        ] {
            let error = with(from, to).expect_err(to);
            assert!(error.contains(words), "{to}: {error}");
        }
        let other = triangles("<robot/>").expect_err("a URDF").to_string();
        assert_eq!(other, "it describes a <robot>, expected a <COLLADA>");
    }

    #[test]
    fn nodes_that_multiply_are_limited() {
        // Each node uses the next one ten times.
        let library: String = (0..20)
            .map(|ix| {
                let next = format!("<instance_node url=\"#n{}\"/>", ix + 1);
                format!("<node id=\"n{ix}\">{}</node>", next.repeat(10))
            })
            .collect();
        let library = format!("<library_nodes>{library}<node id=\"n20\"/></library_nodes>");
        let scene = scene("<node><instance_node url=\"#n0\"/></node>");
        let error = triangles(&file("", TRIANGLES, &format!("{library}{scene}")));
        let error = error.expect_err("too many nodes").to_string();
        assert_eq!(error, "its scene has more than 100000 nodes");
        // A node that uses itself.
        let library =
            "<library_nodes><node id=\"n0\"><instance_node url=\"#n0\"/></node></library_nodes>";
        assert!(triangles(&file("", TRIANGLES, &format!("{library}{scene}"))).is_err());
    }

    #[test]
    fn damaged_files_never_panic() {
        let nodes = "<node><rotate>0 0 1 90</rotate><instance_geometry url=\"#g\"/></node>";
        let whole = file("", TRIANGLES, &scene(nodes));
        for n in 0..whole.len() {
            let _ = triangles(&whole[..n]);
            // Any character may be replaced by any other one.
            for other in ["9", "-", "#", " ", "<", "\""] {
                let _ = triangles(&format!("{}{other}{}", &whole[..n], &whole[n + 1..]));
            }
        }
    }
}
